"""Images, masks and boxes of a distorting lens -> those of a camera without distortion."""

import cv2
import numpy as np
import pytest

from pipeline.functional import distortion
from pipeline.functional.distortion import folds, undistort, undistort_box

K = np.array([[300.0, 0, 150], [0, 310, 125], [0, 0, 1]])
SIZE_HW = (240, 320)
LENSES = [
    (-0.3, 0.08, 0.0, 0.0),
    (0.2, 0.0, 0.003, -0.004),
    (-0.25, 0.1, 0.001, 0.002, -0.02),
    (0.4, 0.1, 0.0, 0.001, 0.01, 0.6, 0.1, 0.02),
]


def grid_of_dots(coefficients: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """A photograph of 5 x 4 dots through the lens, and where a camera without distortion sees them, px."""
    x, y = np.meshgrid(np.linspace(-0.35, 0.35, 5), np.linspace(-0.28, 0.26, 4))
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    seen = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, np.array(coefficients))[0][:, 0]
    row, column = np.mgrid[: SIZE_HW[0], : SIZE_HW[1]]
    dots = sum(np.exp(-((column - u) ** 2 + (row - v) ** 2) / 8) for u, v in seen)
    return (dots * 255).clip(0, 255).astype(np.uint8), rays @ K[:2].T


@pytest.mark.parametrize("coefficients", LENSES)
def test_dots_move_to_where_a_camera_without_distortion_sees_them(coefficients):
    photo, expected = grid_of_dots(coefficients)
    seen = undistort(photo, K, coefficients)
    row, column = np.mgrid[: SIZE_HW[0], : SIZE_HW[1]]
    for x, y in expected:
        weight = seen * ((column - x) ** 2 + (row - y) ** 2 < 36)
        centre = (column * weight).sum() / weight.sum(), (row * weight).sum() / weight.sum()
        np.testing.assert_allclose(centre, (x, y), atol=0.1)


@pytest.mark.parametrize("coefficients", LENSES)
@pytest.mark.parametrize("shape", [(), (3,)])
def test_bands_of_rows_give_the_same_image(monkeypatch, coefficients, shape):
    image = np.random.default_rng(0).integers(0, 256, (*SIZE_HW, *shape), dtype=np.uint8)
    whole = undistort(image, K, coefficients)
    monkeypatch.setattr(distortion, "_BAND_PX", 320 * 37)
    np.testing.assert_array_equal(undistort(image, K, coefficients), whole)
    assert np.abs(whole.astype(int) - cv2.undistort(image, K, np.array(coefficients))).max() <= 8  # 1/32 px


@pytest.mark.parametrize("coefficients", LENSES)
def test_a_mask_keeps_two_values_and_its_box_lies_within_the_boxs_box(coefficients):
    mask = np.zeros(SIZE_HW, bool)
    mask[20:90, 190:290] = True
    moved = undistort(mask, K, coefficients, nearest=True)
    assert moved.dtype == bool
    x0, y0, x1, y1 = undistort_box((189.5, 19.5, 289.5, 89.5), K, coefficients)
    ys, xs = np.nonzero(moved)
    np.testing.assert_allclose((xs.min(), ys.min(), xs.max(), ys.max()), np.clip((x0, y0, x1, y1), 0, 319), atol=1.5)


def test_without_distortion_nothing_moves():
    image = np.random.default_rng(0).integers(0, 256, SIZE_HW, dtype=np.uint8)
    np.testing.assert_array_equal(undistort(image, K, (0.0,) * 5), image)
    np.testing.assert_allclose(undistort_box((3.5, 4.5, 60.5, 70.5), K, (0.0,) * 4), (3.5, 4.5, 60.5, 70.5), atol=1e-9)


@pytest.mark.parametrize("coefficients", [(-2.0, 0, 0, 0), (0.1, -4.0, 0, 0), (-0.5, 0, 0, 0, -20.0)])
def test_coefficients_that_show_a_point_twice_are_noticed(coefficients):
    assert folds(K, coefficients, SIZE_HW)
    assert not any(folds(K, lens, SIZE_HW) for lens in LENSES)


def test_a_box_that_the_lens_cannot_show_is_refused():
    with pytest.raises(ValueError, match="no inverse"):
        undistort_box((-200, -200, 600, 400), K, (-0.6, 0.0, 0.0, 0.0))
