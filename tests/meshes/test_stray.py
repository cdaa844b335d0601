"""Faces far from an object are named; thin parts and meshes of few faces are not."""

import numpy as np
import pytest
import trimesh

from pipeline.io.meshes.stray import describe_stray_faces
from pipeline.items.objects import Mesh
from pipeline.synthetic.objects import make_object

BALL = trimesh.creation.icosphere(3, 50)


def mesh_of(*parts: trimesh.Trimesh) -> Mesh:
    whole = trimesh.util.concatenate(list(parts))
    return Mesh(np.array(whole.vertices), np.array(whole.faces, dtype=np.int64))


@pytest.mark.parametrize("way", [(400, 0, 0), (0, -400, 0), (300, 300, 300)])
@pytest.mark.parametrize("side_mm", [0.1, 3.0])
def test_a_speck_far_away_is_named(way, side_mm):
    speck = trimesh.creation.box((side_mm,) * 3).apply_translation(way)
    (warning,) = describe_stray_faces(mesh_of(BALL, speck))
    assert "of its surface, enlarge it from 173 to" in warning


@pytest.mark.parametrize(
    "mesh",
    [
        mesh_of(trimesh.creation.box((10, 20, 300))),
        mesh_of(BALL),
        mesh_of(BALL, trimesh.creation.cylinder(1, 400, sections=12)),
        mesh_of(BALL, trimesh.creation.box((3, 3, 3)).apply_translation((55, 0, 0))),
        *(make_object(seed) for seed in range(6)),
    ],
)
def test_thin_parts_small_parts_nearby_and_meshes_of_few_faces_are_not_named(mesh):
    assert describe_stray_faces(mesh) == ()
