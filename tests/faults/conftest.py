"""The undisturbed reference run, made once per pytest worker."""

from pathlib import Path

import pytest
from helpers import Inputs, Reference, run_reference
from make_sam import write_sam

from pipeline.synthetic.scenes import write_dataset


@pytest.fixture(scope="session")
def inputs(tmp_path_factory) -> Inputs:
    folder = tmp_path_factory.mktemp("inputs")
    write_dataset(folder / "scene", objects=2, images=2, seed=3, size_hw=(120, 160), per_image=2, progress=False)
    return Inputs(folder / "scene", write_sam(folder / "sam"))


@pytest.fixture(scope="session")
def reference(inputs: Inputs, tmp_path_factory) -> Reference:
    return run_reference(inputs, tmp_path_factory.mktemp("undisturbed"))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "run"
