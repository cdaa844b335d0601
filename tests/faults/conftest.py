"""The undisturbed run, made once for all tests of a worker."""

from pathlib import Path

import pytest
from helpers import Ground, Undisturbed, undisturbed
from make_sam import write_sam

from pipeline.synthetic.scenes import write_dataset


@pytest.fixture(scope="session")
def ground(tmp_path_factory) -> Ground:
    folder = tmp_path_factory.mktemp("ground")
    write_dataset(folder / "scene", objects=2, images=2, seed=3, size_hw=(120, 160), per_image=2, progress=False)
    return Ground(folder / "scene", write_sam(folder / "sam"))


@pytest.fixture(scope="session")
def quiet(ground: Ground, tmp_path_factory) -> Undisturbed:
    return undisturbed(ground, tmp_path_factory.mktemp("undisturbed"))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "run"
