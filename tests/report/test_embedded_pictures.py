"""Pictures on the page: embedded small, and never run as programs."""

import pytest

from pipeline.report.embedded_pictures import small_jpeg


@pytest.mark.parametrize("name", ["picture.jpg", "picture.png", "picture.webp"])
def test_a_picture_that_is_a_program_is_not_run(tmp_path, monkeypatch, name):
    """Pillow hands PostScript to a program whatever the file is called."""
    run_programs = []
    monkeypatch.setattr("subprocess.check_call", lambda *command, **options: run_programs.append(command))
    (tmp_path / name).write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n(ran) print\n%%EOF\n")
    assert small_jpeg(tmp_path / name) == b""
    assert not run_programs
