"""An implausible K is reported with the mistake that would explain it and the K that would fit."""

import numpy as np
import pytest

from pipeline.functional.camera_diagnosis import denormalize_camera, diagnose_camera


def matrix(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize(
    ("values", "size_hw"),
    [
        ((572.4, 573.6, 325.3, 242.0), (480, 640)),
        ((1066.8, 1067.5, 312.99, 241.3), (480, 640)),
        ((3000, 3010, 2010, 1490), (3024, 4032)),
        ((600, 600, 400, 240), (480, 640)),  # 12 % off centre: lenses and crops are like that
        ((320, 320, 319.5, 239.5), (480, 640)),  # 90 degrees wide
    ],
)
def test_plausible_cameras_are_not_reported(values, size_hw):
    assert diagnose_camera(matrix(*values), size_hw) == ""


@pytest.mark.parametrize("scale", [0.25, 0.5, 2 / 3, 1.5, 2.0, 3.0, 4.0])
@pytest.mark.parametrize("size_hw", [(480, 640), (1080, 1920), (640, 480)])
def test_a_camera_of_another_resolution_is_named_with_the_scaled_one(scale, size_hw):
    h, w = size_hw
    fitting = (1.1 * w, 1.1 * w, w / 2 + 3, h / 2 - 2)
    found = diagnose_camera(matrix(*(scale * v for v in fitting)), size_hw)
    assert f"the K of an image of {round(w * scale)} x {round(h * scale)}" in found
    numbers = [float(v) for v in found.rpartition("[")[2].rstrip("]").split(",")]
    np.testing.assert_allclose(numbers, fitting, rtol=0.01)


@pytest.mark.parametrize("order", [(0, 2, 1, 3), (2, 3, 0, 1)])
@pytest.mark.parametrize("values", [(572.4, 573.6, 325.3, 242.0), (1400, 1405, 970, 530)])
def test_another_order_of_the_numbers_is_named(order, values):
    size_hw = (480, 640) if values[2] < 600 else (1080, 1920)
    found = diagnose_camera(matrix(*(values[i] for i in order)), size_hw)
    assert "its order looks like" in found
    assert found.endswith(f"[{', '.join(f'{v:.6g}' for v in values)}]")


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
@pytest.mark.parametrize("size_hw", [(640, 480), (1920, 1080), (1280, 1024)])
def test_the_sensors_camera_beside_a_photograph_that_exif_turns_is_named(orientation, size_hw):
    h, w = size_hw
    sensor = (1.2 * h, 1.2 * h, h / 2, w / 2)
    found = diagnose_camera(matrix(*sensor), size_hw, exif_orientation=orientation)
    assert "EXIF turns this photograph upright" in found
    upright = (1.2 * h, 1.2 * h, w / 2, h / 2)
    assert diagnose_camera(matrix(*upright), size_hw, exif_orientation=orientation) == ""


@pytest.mark.parametrize("corner", [(0.0, 0.0), (12.0, -7.0), (-3.0, 4.0)])
def test_a_principal_point_measured_from_the_centre_is_named(corner):
    found = diagnose_camera(matrix(572, 573, *corner), (480, 640))
    assert "measured from the image's centre" in found
    assert f"{corner[0] + 319.5:g}" in found


def test_unequal_focal_lengths_and_a_far_principal_point_are_reported_without_a_guess():
    assert "fx and fy differ by a factor of 1.40" in diagnose_camera(matrix(572, 800, 325, 242), (480, 640))
    assert "principal point is far from the centre" in diagnose_camera(matrix(572, 573, 100, 242), (480, 640))


def test_a_camera_divided_by_the_images_size_is_recognised():
    assert denormalize_camera(matrix(0.9, 1.2, 0.5, 0.5), (480, 640)) == pytest.approx((576, 576, 320, 240))
    assert denormalize_camera(matrix(572, 573, 325, 242), (480, 640)) is None


@pytest.mark.parametrize(
    ("values", "size_hw"), [((591, 590, 237, 308), (480, 640)), ((900, 900, 635, 480), (1280, 960))]
)
def test_an_exchanged_principal_point_is_named(values, size_hw):
    fx, fy, cx, cy = values
    said = diagnose_camera(matrix(*values), size_hw)
    assert "cx and cy look exchanged" in said or "turned by 90 degrees" in said
    assert diagnose_camera(matrix(fx, fy, cy, cx), size_hw) == ""
