"""Extents of own meshes are stored with the templates: symmetries are found once."""

import numpy as np
from graph.test_keys import bop, photo, stages_of, write_dataset

from pipeline.graph import extents as module
from pipeline.graph.extents import ExtentNodes


def test_symmetries_are_found_once_and_read_back(tmp_path, monkeypatch):
    root = write_dataset(tmp_path / "data")
    context = photo(root).graph()[0].context
    first = ExtentNodes(context).read(1)
    monkeypatch.setattr(module, "mesh_symmetries", None)  # a second search would fail
    again = ExtentNodes(context).read(1)
    for name in ("points", "symmetries", "diameter_mm"):
        np.testing.assert_array_equal(getattr(again, name), getattr(first, name))
    assert first.symmetries.shape[1:] == (4, 4)


def test_a_dataset_that_states_symmetries_has_no_entry(tmp_path):
    root = write_dataset(tmp_path / "data")
    context = bop(root, stages_of("masks", root)).graph()[0].context
    assert ExtentNodes(context).ref(1) is None
    assert len(ExtentNodes(context).read(1).points) > 3
