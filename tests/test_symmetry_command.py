"""dzop symmetry writes models_info.json in millimetres, whatever the meshes' unit."""

import json

import pytest
import trimesh

from pipeline.cli.symmetry import symmetry_command
from pipeline.errors import BadInput


@pytest.mark.parametrize(("units", "factor"), [("mm", 1.0), ("cm", 10.0), ("m", 1000.0), ("inch", 25.4)])
def test_diameters_are_in_millimetres(tmp_path, units, factor):
    trimesh.creation.box((60 / factor, 40 / factor, 30 / factor)).export(tmp_path / "obj_000005.ply")
    symmetry_command([str(tmp_path / "obj_000005.ply"), "--units", units, "--out", str(tmp_path / "info.json")])
    record = json.loads((tmp_path / "info.json").read_text())["5"]
    assert record["diameter"] == pytest.approx(78.1, abs=0.05)
    assert len(record["symmetries_discrete"]) == 3


def test_a_mesh_in_metres_is_refused_and_nothing_written(tmp_path):
    trimesh.creation.box((0.06, 0.04, 0.03)).export(tmp_path / "box.ply")
    with pytest.raises(BadInput, match=r"box\.ply: found a mesh of diameter 0\.078.*metres"):
        symmetry_command([str(tmp_path / "box.ply"), "--out", str(tmp_path / "info.json")])
    assert not (tmp_path / "info.json").exists()
