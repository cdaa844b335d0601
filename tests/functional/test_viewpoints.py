import numpy as np
import pytest

from pipeline.functional.rigid import rotation_angle_deg
from pipeline.functional.viewpoints import (
    add_inplane_turns,
    fibonacci,
    icosphere,
    icosphere_mesh,
    superfibonacci,
    viewpoint_rotations,
)

SETS = ("icosphere_upper", "icosphere", "fibonacci", "superfibonacci")


def farthest_gap_deg(directions: np.ndarray, probes: np.ndarray) -> float:
    """Largest angle from any probe to its nearest direction."""
    return float(np.degrees(np.arccos(np.clip((probes @ directions.T).max(axis=1), -1, 1)).max()))


def angles_deg(R_a: np.ndarray, R_b: np.ndarray) -> np.ndarray:
    """Geodesic angle of every pair, degrees."""
    shape = (len(R_a), len(R_b), 3, 3)
    return rotation_angle_deg(np.broadcast_to(R_a[:, None], shape), np.broadcast_to(R_b[None], shape))


@pytest.fixture(scope="module")
def probes():
    p = np.random.default_rng(0).normal(size=(4000, 3))
    return p / np.linalg.norm(p, axis=-1, keepdims=True)


@pytest.mark.parametrize("name", SETS)
def test_every_set_has_distinct_rotations_and_is_deterministic(name):
    R = viewpoint_rotations(name, 200, 2)
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)  # float64
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-12)
    angles = angles_deg(R, R)
    assert (angles + 360 * np.eye(len(R))).min() > 1.0
    np.testing.assert_array_equal(R, viewpoint_rotations(name, 200, 2))


def test_level_2_has_301_directions_above_the_horizon_as_in_the_paper():
    directions = icosphere(2)
    assert len(directions) == 642
    assert (directions[:, 2] > 0).sum() == 301
    assert (directions[:, 2] == 0).sum() == 40
    assert len(viewpoint_rotations("icosphere_upper", 1)) == 301
    assert len(viewpoint_rotations("icosphere", 1, 3)) == 3 * 642


def test_levels_0_and_1_have_42_and_162_directions():
    assert [len(icosphere(level)) for level in (0, 1)] == [42, 162]


def test_sphere_is_closed_and_wound_outwards():
    points, faces = icosphere_mesh(1)
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=-1).reshape(-1, 2)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    a, b, c = (points[faces[:, k]] for k in range(3))
    assert ((np.cross(b - a, c - a) * a).sum(-1) > 0).all()


def test_upper_set_covers_the_hemisphere_and_full_sets_the_sphere(probes):
    eye = -viewpoint_rotations("icosphere_upper", 1)[:, 2]  # the optical axis is the third row
    assert (eye[:, 2] > 0).all()
    assert farthest_gap_deg(eye, probes[probes[:, 2] > 0.1]) < 6  # edges of 7.5 to 9 degrees
    assert farthest_gap_deg(-viewpoint_rotations("icosphere", 1)[:, 2], probes) < 6


@pytest.mark.parametrize("n", [1, 2, 12, 300, 1000])
def test_fibonacci_covers_the_sphere_for_any_n(n, probes):
    directions = fibonacci(n)
    assert directions.shape == (n, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1, atol=1e-12)
    if n >= 12:
        # a cap of equal share has radius sqrt(4 / n); the spiral leaves gaps of about 1.4 of that
        assert farthest_gap_deg(directions, probes) < 1.6 * np.degrees(2 / n**0.5)


def test_superfibonacci_covers_rotations_more_evenly_than_random():
    rng = np.random.default_rng(0)
    q, r = np.linalg.qr(rng.normal(size=(1500, 3, 3)))
    q = q * np.sign(np.diagonal(r, axis1=1, axis2=2))[:, None]
    q *= np.sign(np.linalg.det(q))[:, None, None]
    spiral, chance = superfibonacci(500), q[1000:]
    gap = [angles_deg(q[:1000], R).min(axis=1).max() for R in (spiral, chance)]
    assert gap[0] < 30  # 500 balls of equal share of SO(3) have a radius of 21 degrees
    assert gap[0] < 0.75 * gap[1]


def test_inplane_rotations_keep_the_viewing_direction_and_complete_the_circle():
    R = viewpoint_rotations("fibonacci", 7)
    turned = add_inplane_turns(R, 4).reshape(7, 4, 3, 3)
    np.testing.assert_allclose(turned[:, 0], R, atol=1e-15)
    np.testing.assert_allclose(turned[..., 2, :], np.repeat(R[:, None, 2], 4, axis=1), atol=1e-15)
    np.testing.assert_allclose(rotation_angle_deg(turned[:, 1], turned[:, 2]), 90, atol=1e-9)
    np.testing.assert_allclose(rotation_angle_deg(turned[:, 3], turned[:, 0]), 90, atol=1e-9)
