import numpy as np
import pytest

from pipeline.functional.camera import resize_affine, square_crop
from pipeline.functional.resample import resample


@pytest.mark.parametrize("side", [20.0, 31.3, 37.3, 64.0])
def test_linear_ramp_keeps_its_values_at_pixel_centres(side):
    ramp = np.add.outer(3.0 * np.arange(100), 2.0 * np.arange(110)).astype(np.float32)
    box = (50.2 - side / 2, 45.7 - side / 2, 50.2 + side / 2, 45.7 + side / 2)
    A = square_crop(box, size=32, padding_ratio=1.0)
    x, y = ((np.arange(32) - A[i, 2]) / A[i, i] for i in (0, 1))
    # enlarged: float32 rounding of values about 500; shrunk: area means are off by 1/8 step per axis
    tolerance = 1e-3 if side < 32 else (3 + 2) / 8
    assert np.abs(resample(ramp, A, size=32) - np.add.outer(3.0 * y, 2.0 * x)).max() < tolerance


def test_shrinking_by_an_integer_factor_averages_pixels():
    image = np.random.default_rng(0).random((12, 12, 3)).astype(np.float32)
    expected = image.reshape(4, 3, 4, 3, 3).mean((1, 3))
    assert np.allclose(resample(image, resize_affine(1 / 3), size=4), expected, atol=1e-6)  # float32 sums of 9


def test_identity_gives_the_image():
    image = np.random.default_rng(1).random((9, 9)).astype(np.float32)
    assert np.array_equal(resample(image, np.eye(3), size=9), image)


def test_crop_is_zero_outside_the_image_and_has_no_offset():
    image = np.ones((10, 10), np.float32)
    A = square_crop((-5.5, -5.5, 4.5, 4.5), size=10, padding_ratio=1.0)
    crop = resample(image, A, size=10)
    assert np.array_equal(crop > 0, np.pad(np.ones((5, 5), bool), ((5, 0), (5, 0))))
    far = square_crop((100.0, 100.0, 110.0, 110.0), size=10, padding_ratio=1.0)
    assert not resample(image, far, size=10).any()
