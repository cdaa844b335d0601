"""Of a file with several frames the first is read, and the run says so."""

from pathlib import Path

import numpy as np
import PIL.Image
import pytest
from command import run_dzop

from pipeline.bop.images import count_frames

RNG = np.random.default_rng(0)


def write_frames(path: Path, count: int) -> Path:
    frames = [PIL.Image.fromarray(RNG.integers(0, 255, (48, 64, 3), np.uint8)) for _ in range(count)]
    frames[0].save(path, save_all=count > 1, append_images=frames[1:])
    return path


@pytest.mark.parametrize("suffix", ["gif", "tiff", "webp", "png"])
@pytest.mark.parametrize("count", [1, 3])
def test_frames_are_counted(tmp_path: Path, suffix: str, count: int):
    assert count_frames(write_frames(tmp_path / f"shot.{suffix}", count)) == count


def test_a_file_that_cannot_be_read_has_one_frame(tmp_path: Path):
    (tmp_path / "shot.gif").write_bytes(b"GIF89a")
    assert count_frames(tmp_path / "shot.gif") == 1


@pytest.mark.parametrize("count", [1, 3])
def test_a_run_says_that_the_first_frame_is_used(capsys, monkeypatch, tmp_path, scene, count):
    monkeypatch.chdir(tmp_path)
    given = (f"dataset.image={write_frames(tmp_path / 'shot.gif', count)}", "dataset.bbox=[10,10,30,30]")
    camera, mesh = "dataset.K=[80,80,32,24]", f"dataset.mesh={scene}/models/obj_000001.ply"
    ran = run_dzop(capsys, monkeypatch, "dataset=photo", *given, camera, mesh, "extract=hog", "step=detect")
    assert ran.status == 0, ran.err
    assert ("its file has 3 frames: the first is used" in ran.out) == (count == 3)
