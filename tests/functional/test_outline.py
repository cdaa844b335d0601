"""A pose fitted to matches and to the outline of a mask, which may be too wide or partly that of an occluder."""

import numpy as np
import pytest

from pipeline.functional.outline import fit_outline, outline_px, signed_distance_px
from pipeline.functional.rigid import rigid

SIZE, FOCAL, FAR = 128, 500.0, 500.0
K_CROP = np.array([[FOCAL, 0, 63.5], [0, FOCAL, 63.5], [0, 0, 1]])
TRUE = rigid(np.eye(3), np.array([0.0, 0.0, FAR]))


def disc(radius_px: float = 40.0) -> np.ndarray:
    y, x = np.mgrid[:SIZE, :SIZE] - 63.5
    return np.hypot(x, y) <= radius_px


def lifted(px: np.ndarray) -> np.ndarray:
    """Points of a plane at the true depth, which is the object; 1 mm is 1 px."""
    return np.column_stack([px - 63.5, np.zeros(len(px))])


def nearer(share: float) -> np.ndarray:
    return rigid(np.eye(3), np.array([0.0, 0.0, FAR * (1 - share)]))


def fitted(mask: np.ndarray, start: np.ndarray, *, noise: np.ndarray | float = 0.0, weight: float = 3.0) -> np.ndarray:
    """The fit of a disc, from matches with ``noise`` (px)."""
    px = np.random.default_rng(0).uniform(40, 88, (200, 2))
    matched = lifted(px), px + noise
    outline = lifted(outline_px(disc()))
    return fit_outline(start, K_CROP, matched, outline, signed_distance_px(mask), weight=weight)


def test_distances_are_those_to_the_border_between_two_pixels():
    mask = np.zeros((9, 9), bool)
    mask[:, 3:] = True
    assert signed_distance_px(mask)[4].tolist() == [2.5, 1.5, 0.5, -0.5, -1.5, -2.5, -3.5, -4.5, -5.5]


def test_the_outline_leaves_out_the_edge_of_the_crop():
    mask = np.zeros((9, 9), bool)
    mask[2:, 4:7] = True
    assert outline_px(mask)[:3].tolist() == [[4, 2], [5, 2], [6, 2]]
    assert outline_px(mask)[:, 1].max() == 7


@pytest.mark.parametrize("share", [-0.03, 0.03])
def test_a_wrong_depth_is_put_right(share):
    assert fitted(disc(), nearer(share))[2, 3] == pytest.approx(FAR, rel=2e-3)


def test_a_mask_that_is_too_wide_does_not_bring_the_object_nearer():
    for radius_px in (38.0, 42.0):
        depth_mm = fitted(disc(radius_px), TRUE)[2, 3]
        assert depth_mm == pytest.approx(FAR, rel=0.01)  # 0.05 if the mask were believed; its pixels are the noise


def test_the_outline_says_where_the_object_is():
    shifted = rigid(np.eye(3), np.array([2.0, -1.0, FAR]))
    noise = np.random.default_rng(1).uniform(-2, 2, (200, 2))  # matches that are off by up to two pixels
    x = {weight: fitted(disc(), shifted, noise=noise, weight=weight)[:2, 3] for weight in (0.3, 30.0)}
    assert np.linalg.norm(x[30.0]) < np.linalg.norm(x[0.3])


def test_the_border_of_an_occluder_does_not_count():
    hidden = disc()
    hidden[:, 80:] = False
    assert np.abs(fitted(hidden, nearer(0.01)) - TRUE)[:3, 3].max() < 0.005 * FAR


def test_too_few_points_leave_the_pose_as_it_is():
    few = np.zeros((5, 3)), np.zeros((5, 2))
    start = nearer(0.02)
    outline = lifted(outline_px(disc()))
    assert fit_outline(start, K_CROP, few, outline, signed_distance_px(disc()), weight=3.0) is start
