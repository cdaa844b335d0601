import numpy as np
import pytest

from pipeline.functional.camera import apply_homography, crop_camera, local_zoom, project, square_crop, virtual_crop
from pipeline.functional.resample import resample, warp
from pipeline.functional.rigid import rotation_between

K = np.array([[600.0, 0.0, 310.0], [0.0, 580.0, 250.0], [0.0, 0.0, 1.0]])
BOX = (520.5, 30.5, 600.5, 90.5)  # near the upper right corner of a 640 x 480 image


def _points(count: int = 50) -> np.ndarray:
    return np.random.default_rng(0).uniform((80, -110, 400), (180, -50, 500), (count, 3))


def test_homography_equals_homogeneous_coordinates_and_is_exact_if_affine():
    px = np.random.default_rng(1).uniform(0, 600, (20, 2))
    A = virtual_crop(BOX, K, size=128, padding_ratio=1.2)
    homogeneous = np.concatenate([px, np.ones((20, 1))], axis=1) @ A.T
    np.testing.assert_allclose(apply_homography(A, px), homogeneous[:, :2] / homogeneous[:, 2:], rtol=1e-12)
    square = square_crop(BOX, size=128, padding_ratio=1.2)
    assert np.array_equal(apply_homography(square, px), px @ square[:2, :2].T + square[:2, 2])
    np.testing.assert_allclose(apply_homography(np.linalg.inv(A), apply_homography(A, px)), px, atol=1e-7)


def test_projection_by_the_virtual_camera_equals_the_crop_of_the_projection():
    A = virtual_crop(BOX, K, size=128, padding_ratio=1.2)
    K_crop, R_crop_cam = crop_camera(A, K)
    points = _points()
    np.testing.assert_allclose(
        project(K_crop, points @ R_crop_cam.T), apply_homography(A, project(K, points)), atol=1e-8
    )
    ray = np.linalg.inv(K) @ [560.5, 60.5, 1.0]
    np.testing.assert_allclose(R_crop_cam, rotation_between(ray, np.array([0.0, 0, 1])), atol=1e-12)
    np.testing.assert_allclose(K_crop, [[K_crop[0, 0], 0, 63.5], [0, K_crop[0, 0], 63.5], [0, 0, 1]], atol=1e-9)


def test_padded_box_fills_the_virtual_crop_and_is_centred():
    A = virtual_crop(BOX, K, size=128, padding_ratio=1.25)
    np.testing.assert_allclose(apply_homography(A, np.array([560.5, 60.5])), [63.5, 63.5], atol=1e-9)
    corners = np.array([[x, y] for x in (510.5, 610.5) for y in (10.5, 110.5)])  # 1.25 times 80 px
    at = np.abs(apply_homography(A, corners) - 63.5)
    assert at.max() == pytest.approx(64)
    assert at.min() > 50  # 27 degrees off the axis, the square is a trapezoid


def test_virtual_crop_equals_square_crop_on_the_optical_axis():
    straight = np.array([[600.0, 0.0, 319.5], [0.0, 600.0, 239.5], [0.0, 0.0, 1.0]])
    box = (299.5, 209.5, 339.5, 269.5)
    virtual, square = (
        virtual_crop(box, straight, size=64, padding_ratio=1.2),
        square_crop(box, size=64, padding_ratio=1.2),
    )
    np.testing.assert_allclose(virtual, square, atol=1e-9)


def test_crop_that_scales_and_shifts_has_no_rotation():
    A = square_crop(BOX, size=128, padding_ratio=1.2)
    K_crop, R_crop_cam = crop_camera(A, K)
    np.testing.assert_allclose(K_crop, A @ K, rtol=1e-14)
    assert np.array_equal(R_crop_cam, np.eye(3))
    for scale in (-3.0, 1e-4):  # scale and sign of a homography are arbitrary
        again = crop_camera(scale * virtual_crop(BOX, K, size=128, padding_ratio=1.2), K)
        first = crop_camera(virtual_crop(BOX, K, size=128, padding_ratio=1.2), K)
        for a, b in zip(again, first, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-9)
        assert np.linalg.det(again[1]) == pytest.approx(1)


def test_local_zoom_equals_the_growth_of_a_small_square():
    A, px, step = virtual_crop(BOX, K, size=128, padding_ratio=1.2), np.array([[530.0, 40.0], [590.0, 80.0]]), 1e-4
    dx, dy = ((apply_homography(A, px + d) - apply_homography(A, px - d)) / (2 * step) for d in ((step, 0), (0, step)))
    area = np.abs(dx[:, 0] * dy[:, 1] - dx[:, 1] * dy[:, 0])
    np.testing.assert_allclose(local_zoom(A, px), np.sqrt(area), rtol=1e-6)
    assert local_zoom(3.0 * square_crop(BOX, size=128, padding_ratio=1.0), px) == pytest.approx(128 / 80)


def test_box_of_90_degrees_is_rejected():
    with pytest.raises(ValueError, match="90 degrees or more from its centre"):
        virtual_crop((5e5, 5e5, 9e6, 9e6), K, size=64, padding_ratio=1.2)


@pytest.mark.parametrize("side", [20.0, 40.0, 70.0, 200.0])
def test_warped_ramp_keeps_its_values_at_pixel_centres(side):
    ramp = np.add.outer(0.5 * np.arange(480), 0.25 * np.arange(640)).astype(np.float32)
    A = virtual_crop((400.0, 100.0, 400.0 + side, 100.0 + side), K, size=40, padding_ratio=1.0)
    grid = np.stack(np.meshgrid(np.arange(40), np.arange(40)), -1).astype(float)
    px = apply_homography(np.linalg.inv(A), grid)
    expected = 0.5 * px[..., 1] + 0.25 * px[..., 0]
    # shrunk: averages samples over a pixel, inside which the map is not affine
    assert np.abs(warp(ramp, A, size=40) - expected).max() < 5e-3


def test_warp_equals_resample_without_perspective():
    image = np.random.default_rng(0).random((50, 60, 3)).astype(np.float32)
    larger = square_crop((20.2, 10.7, 35.2, 25.7), size=32, padding_ratio=1.1)
    assert np.allclose(warp(image, larger, size=32), resample(image, larger, size=32), atol=1e-5)  # float32
    assert np.array_equal(warp(image[:, :50], np.eye(3), size=50), image[:, :50])
    smooth = np.add.outer(np.sin(np.arange(90) / 9), np.cos(np.arange(90) / 7)).astype(np.float32)
    smaller = square_crop((8.0, 8.0, 80.0, 80.0), size=24, padding_ratio=1.0)
    assert np.abs(warp(smooth, smaller, size=24) - resample(smooth, smaller, size=24)).max() < 0.02  # warp is softer


def test_warp_is_zero_outside_the_image_and_has_no_offset():
    image = np.ones((10, 10), np.float32)
    A = square_crop((-5.5, -5.5, 4.5, 4.5), size=10, padding_ratio=1.0)
    assert np.array_equal(warp(image, A, size=10) > 0, np.pad(np.ones((5, 5), bool), ((5, 0), (5, 0))))
    far = square_crop((1e7, 1e7, 1e7 + 10, 1e7 + 10), size=10, padding_ratio=1.0)
    assert not warp(image, far, size=10).any()
