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


@pytest.mark.parametrize("depth_range", [0.0, 0.02, 0.05])
def test_a_near_planar_set_is_skipped_or_checked_as_asked(depth_range):
    a, b = _two_views(depth_range)
    wrong = np.arange(30)
    b[wrong] = np.random.default_rng(1).uniform(5, 60, (30, 2))
    checked = {
        planar: epipolar_inliers(a, b, threshold=1.0, iterations=1000, seed=0, planar=planar)
        for planar in ("skip", "fundamental", "homography")
    }
    assert checked["skip"][0] is None
    for planar in ("fundamental", "homography"):
        keep, reason = checked[planar]
        assert reason == ""
        assert keep[30:].mean() > 0.95
        assert keep[:30].mean() < 0.2
    # a plane fixes both coordinates of a point, an epipolar line one
    assert checked["homography"][0][:30].sum() <= checked["fundamental"][0][:30].sum()


@pytest.mark.parametrize("planar", ["fundamental", "homography"])
def test_a_set_with_depth_is_checked_by_the_fundamental_matrix_whatever_planar_is(planar):
    a, b = _two_views(depth_range=1.0)
    b[:30] = np.random.default_rng(1).uniform(5, 60, (30, 2))
    expected, _ = epipolar_inliers(a, b, threshold=1.0, iterations=1000, seed=0)
    keep, _ = epipolar_inliers(a, b, threshold=1.0, iterations=1000, seed=0, planar=planar)
    assert np.array_equal(keep, expected)


@pytest.mark.parametrize("planar", ["fundamental", "homography"])
@pytest.mark.parametrize("points", [np.ones((20, 2)), np.arange(20.0)[:, None] * [1, 2], np.ones((7, 2))])
def test_no_matrix_is_said_and_not_an_error(planar, points):
    keep, reason = epipolar_inliers(points, points, threshold=1.0, iterations=1000, seed=0, planar=planar)
    assert keep is None or keep.all()
    assert bool(reason) == (keep is None)
