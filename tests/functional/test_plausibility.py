"""What cannot be right in a photograph, a distance or a mesh is said; what is merely unusual is not."""

import numpy as np
import pytest
import trimesh

from pipeline.functional.plausibility import (
    diagnose_contrast,
    diagnose_depth,
    diagnose_distance,
    diagnose_shape,
    estimate_distance,
)

SIZE_HW = (240, 320)
MASK = np.zeros(SIZE_HW, bool)
MASK[60:180, 80:260] = True


def noise(low: int, high: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(low, high, (*SIZE_HW, 3), np.uint8)


def ramp(width: int, size_hw: tuple[int, int] = SIZE_HW) -> np.ndarray:
    """Grey from 0 to ``width`` from left to right."""
    row = np.linspace(0, width, size_hw[1]).astype(np.uint8)
    return np.broadcast_to(row[None, :, None], (*size_hw, 3)).copy()


def outline_alone() -> np.ndarray:
    """A photograph with contrast, except inside the mask."""
    return np.where(MASK[..., None], np.uint8(90), noise(0, 255))


EMPTY = {
    "one colour": np.full((*SIZE_HW, 3), 128, np.uint8),
    "black": np.zeros((*SIZE_HW, 3), np.uint8),
    "overexposed": np.full((*SIZE_HW, 3), 255, np.uint8),
    "a coloured sheet": np.full((*SIZE_HW, 3), (200, 30, 30), np.uint8),
    "noise of a sensor": noise(126, 131),
    "a gradient": ramp(255),
    "nothing inside the mask": outline_alone(),
}
SHOWN = {
    "noise": noise(0, 255),
    "dim": noise(0, 40),
    "stripes": np.where((np.arange(SIZE_HW[1]) // 20 % 2)[None, :, None], 60, 100).repeat(240, 0).repeat(3, 2),
}


@pytest.mark.parametrize("name", EMPTY)
def test_pixels_that_show_nothing_are_said(name):
    assert "shows almost nothing there (grey levels vary by " in diagnose_contrast(EMPTY[name], MASK)


@pytest.mark.parametrize("name", SHOWN)
def test_pixels_that_show_something_are_not(name):
    assert diagnose_contrast(SHOWN[name].astype(np.uint8), MASK) == ""


def test_contrast_is_that_of_the_object_at_any_resolution():
    large = np.kron(noise(0, 255), np.ones((8, 8, 1), np.uint8))
    assert diagnose_contrast(large, np.kron(MASK, np.ones((8, 8), bool))) == ""
    assert diagnose_contrast(ramp(255, (1920, 2560)), np.ones((1920, 2560), bool))
    assert diagnose_contrast(noise(0, 255), np.zeros(SIZE_HW, bool)) == ""  # an empty mask is another check's


@pytest.mark.parametrize(
    ("diameter_mm", "said"),
    [
        (100.0, ""),
        (100 / 25.4, "is the mesh in inches or centimetres?"),
        (10.0, "or centimetres?"),
        (0.1, "is the mesh in metres?"),
        (100_000.0, "check K and the mesh's unit"),
    ],
)
def test_a_distance_that_no_photograph_is_taken_from_is_said_with_the_units_that_explain_it(diameter_mm, said):
    problem = diagnose_distance(estimate_distance(diameter_mm, 600.0, 75.0))  # 100 mm are 800 mm away
    assert said in problem
    assert (problem == "") == (said == "")


@pytest.mark.parametrize(
    ("scale", "said"),
    [(1.0, ""), (0.001, "=1000 times"), (0.1, "=10 times"), (10.0, "=0.1 times"), (4.0, "check K, the mask")],
)
def test_depth_of_another_scale_is_said_with_the_one_that_fits(scale, said):
    problem = diagnose_depth(scale * np.linspace(780, 900, 50), 800.0)
    assert said in problem
    assert (problem == "") == (said == "")
    assert diagnose_depth(np.zeros(0), 800.0) == ""


def vertices_of(mesh: trimesh.Trimesh) -> np.ndarray:
    """Turned, so that a plane is not one of the axes."""
    return mesh.vertices @ trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])[:3, :3].T + [300.0, -40, 9]


FLAT = {
    "triangle": (np.array([[0.0, 0, 0], [100, 0, 0], [0, 60, 0]]), "flat (115 x 55.8 x 0 mm)"),
    "sheet": (vertices_of(trimesh.creation.box((100, 60, 0))), "flat (100 x 60 x 0 mm)"),
    "disc": (vertices_of(trimesh.creation.cylinder(40, 0.01)), "flat ("),
    "foil": (vertices_of(trimesh.creation.box((100, 60, 0.02))), "flat (100 x 60 x 0.02 mm)"),
    "wire": (vertices_of(trimesh.creation.box((300, 0.1, 0.1))), "a line (300"),
}


@pytest.mark.parametrize("name", FLAT)
def test_a_mesh_without_thickness_is_said(name):
    vertices, said = FLAT[name]
    assert f"it is {said}" in diagnose_shape(vertices)


@pytest.mark.parametrize("mesh", [trimesh.creation.box((100, 60, 1)), trimesh.creation.icosphere(2, 30)])
def test_a_mesh_with_thickness_is_not(mesh):
    assert diagnose_shape(vertices_of(mesh)) == ""
