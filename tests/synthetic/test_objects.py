import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from pipeline.functional.viewpoints import superfibonacci
from pipeline.io.meshes import diameter_mm
from pipeline.synthetic.objects import DIAMETERS_MM, FAMILIES, make_object

SEEDS = range(2 * len(FAMILIES))


@pytest.mark.parametrize("seed", SEEDS)
def test_objects_are_closed_have_the_right_size_and_are_reproducible(seed):
    mesh = make_object(seed)
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.volume > 0
    assert DIAMETERS_MM[0] < diameter_mm(mesh) < DIAMETERS_MM[1]
    assert 2_000 <= len(mesh.faces) <= 21_000
    again = make_object(seed)
    assert again.digest == mesh.digest
    np.testing.assert_array_equal(again.colours, mesh.colours)


def test_seeds_differ():
    assert len({make_object(seed).digest for seed in SEEDS}) == len(SEEDS)


@pytest.mark.parametrize("seed", SEEDS)
def test_no_rotation_maps_an_object_onto_itself(seed):
    """Nearest points under 400 rotations differ in place, by share of the diameter, or in colour."""
    mesh = make_object(seed)
    points, colours = mesh.vertices[::7] / diameter_mm(mesh), mesh.colours[::7] / 255.0
    centred = points - points.mean(axis=0)
    tree = cKDTree(centred)
    apart = []
    for R in superfibonacci(400):
        if np.trace(R) > 1 + 2 * np.cos(np.radians(30)):
            continue  # almost the identity
        distance, index = tree.query(centred @ R.T)
        apart.append(distance.mean() + 0.2 * np.abs(colours - colours[index]).mean())
    assert min(apart) > 0.02


def test_textures_have_contrast():
    for seed in SEEDS:
        colours = make_object(seed).colours.astype(float)
        assert colours.std(axis=0).max() > 25
        assert 30 < colours.mean() < 220
