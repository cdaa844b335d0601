"""Timings that cannot be saved or read cost a plan its seconds, and nothing else."""

import json
from pathlib import Path

import pytest

from pipeline.graph.timings import FOLDER, Timings


def saved(folder: Path) -> Path:
    timings = Timings(folder, "cpu")
    timings.add("step", 4, 2.0)
    timings.save()
    (path,) = (folder / FOLDER).glob("*.json")
    return path


def test_saved_timings_are_found_again(tmp_path: Path):
    saved(tmp_path)
    assert Timings(tmp_path, "cpu").seconds("step", 8) == 4.0


def block_folder(tmp_path: Path) -> None:
    (tmp_path / FOLDER).write_text("a file")


def block_file(tmp_path: Path) -> None:
    path = saved(tmp_path)
    path.unlink()
    path.mkdir()


def dangle(tmp_path: Path) -> None:
    (tmp_path / FOLDER).symlink_to(tmp_path / "gone" / "further")


@pytest.mark.parametrize("block", [block_folder, block_file, dangle])
def test_timings_that_cannot_be_written_are_no_error(tmp_path: Path, block):
    block(tmp_path)
    timings = Timings(tmp_path, "cpu")
    timings.add("step", 4, 2.0)
    timings.save()
    assert Timings(tmp_path, "cpu").seconds("other", 1) is None


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "null", "\0\0", '{"step": 3}', '{"step": [1]}', '{"step": ["a", "b"]}', '{"step": [1, NaN]}',
     '{"step": [Infinity, 1]}', '{"step": [0, 1]}', '{"step": [1, -1]}', '{"step": [1e999, 1]}', "[" * 100_000,
     '{"step": [1, %s]}' % ("9" * 400)],
)  # fmt: skip
def test_damaged_timings_are_ignored_and_written_again(tmp_path: Path, text: str):
    path = saved(tmp_path)
    path.write_text(text)
    assert Timings(tmp_path, "cpu").seconds("step", 8) is None
    timings = Timings(tmp_path, "cpu")
    timings.add("other", 1, 3.0)
    timings.save()
    assert json.loads(path.read_text()) == {"other": [1.0, 3.0]}
