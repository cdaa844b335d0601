import cv2
import numpy as np
import pytest

from pipeline.functional.epipolar import epipolar_inliers


def _two_views(depth_range: float, n: int = 120, turn: float = 0.4) -> tuple[np.ndarray, np.ndarray]:
    """Projections of random points in two views, in cells of a 64 x 64 map."""
    points = np.random.default_rng(0).uniform(-1, 1, (n, 3)) * [1, 1, depth_range]
    views = []
    for angle in (0.0, turn):
        p = points @ cv2.Rodrigues(np.array([0.0, angle, 0.1]))[0].T + [0, 0, 5]
        views.append(32 + 130 * p[:, :2] / p[:, 2:])
    return views[0], views[1]


def test_outliers_are_dropped_and_inliers_kept():
    a, b = _two_views(depth_range=1.0)
    b[:30] = np.random.default_rng(1).uniform(5, 60, (30, 2))
    keep, reason = epipolar_inliers(a, b, threshold=1.0, iterations=1000, seed=0)
    assert reason == ""
    assert keep[30:].mean() > 0.95  # a few true pairs are lost if an outlier fits the matrix by chance
    assert keep[:30].mean() < 0.2  # a band of 2 in 55 cells holds 4 % of random points, at most seven of them sampled


def test_result_is_deterministic_and_independent_of_order():
    a, b = _two_views(depth_range=1.0)
    first, _ = epipolar_inliers(a, b, threshold=1.0, iterations=1000, seed=0)
    second, _ = epipolar_inliers(a, b, threshold=1.0, iterations=1000, seed=0)
    assert np.array_equal(first, second)
    assert first.all()


@pytest.mark.parametrize(
    ("a", "b", "reason"),
    [
        (*(v[:7] for v in _two_views(1.0)), "7 pairs, a fundamental matrix needs 8"),
        (*_two_views(0.0), "near-planar"),
        (*_two_views(1.0, turn=0.0), "near-planar"),
        (np.arange(20.0)[:, None] * [1, 2], np.arange(20.0)[:, None] * [1, 2], "points nearly on a line"),
        (np.ones((20, 2)), np.ones((20, 2)), "points nearly on a line"),
    ],
)
def test_degenerate_configurations_are_reported(a, b, reason):
    keep, said = epipolar_inliers(a, b, threshold=1.0, iterations=1000, seed=0)
    assert keep is None
    assert said.startswith(reason)
