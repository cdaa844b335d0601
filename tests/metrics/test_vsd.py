import numpy as np

from pipeline.metrics.recall import TAUS
from pipeline.metrics.vsd import distance_map, vsd

K = np.array([[100.0, 0, 15.5], [0, 100.0, 11.5], [0, 0, 1]])
OPTIONS = {"diameter_mm": 100.0, "delta_mm": 15.0, "taus": TAUS}


def render_plate(depth_mm: float, columns: slice) -> np.ndarray:
    depth = np.zeros((24, 32), np.float32)
    depth[8:16, columns] = depth_mm
    return depth


def test_same_surface_has_error_0_and_disjoint_surfaces_1():
    here, there, wall = (
        render_plate(500, slice(4, 12)),
        render_plate(500, slice(20, 28)),
        np.full((24, 32), 900, np.float32),
    )
    assert vsd(here, here, wall, K, **OPTIONS).tolist() == [0.0] * 10
    assert vsd(there, here, wall, K, **OPTIONS).tolist() == [1.0] * 10


def test_half_overlap_is_two_thirds_of_the_union():
    here, moved, wall = (
        render_plate(500, slice(4, 12)),
        render_plate(500, slice(8, 16)),
        np.full((24, 32), 900, np.float32),
    )
    np.testing.assert_allclose(vsd(moved, here, wall, K, **OPTIONS), 2 / 3)


def test_surface_off_by_22_mm_is_wrong_only_for_smaller_tolerances():
    near, far, wall = (
        render_plate(500, slice(4, 12)),
        render_plate(522, slice(4, 12)),
        np.full((24, 32), 900, np.float32),
    )
    # 22 mm of depth are up to 22.2 mm of distance; tolerances are 5, 10, ... mm
    assert vsd(far, near, wall, K, **OPTIONS).tolist() == [1.0] * 4 + [0.0] * 6


def test_hidden_surface_does_not_count():
    here = render_plate(500, slice(4, 12))
    half_hidden = np.full((24, 32), 900, np.float32)
    half_hidden[:, :8] = 300
    moved = render_plate(500, slice(8, 16))
    # visible: columns 8 to 11 of the true one, all of the other
    np.testing.assert_allclose(vsd(moved, here, half_hidden, K, **OPTIONS), 4 / 8)
    assert vsd(here, here, np.full((24, 32), 300, np.float32), K, **OPTIONS).tolist() == [1.0] * 10


def test_missing_measured_depth_counts_as_visible():
    here, nothing = render_plate(500, slice(4, 12)), np.zeros((24, 32), np.float32)
    assert vsd(here, here, nothing, K, **OPTIONS).tolist() == [0.0] * 10


def test_distance_map_has_ray_lengths():
    distance = distance_map(np.full((24, 32), 200.0), K)
    x, y = (0 - 15.5) / 100 * 200, (0 - 11.5) / 100 * 200
    assert np.isclose(distance[0, 0], np.linalg.norm([x, y, 200]))
    assert distance_map(np.zeros((24, 32)), K).max() == 0
