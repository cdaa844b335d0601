import cv2
import numpy as np
import pytest

from pipeline.functional.camera import apply_homography, project, square_crop
from pipeline.functional.rigid import rigid, transform
from pipeline.stages.lift import lift

K = np.array([[500.0, 0.0, 63.5], [0.0, 500.0, 47.5], [0.0, 0.0, 1.0]])
T = rigid(cv2.Rodrigues(np.array([0.5, -0.3, 1.0]))[0], np.array([10.0, -5.0, 600.0]))
A = square_crop((30.0, 20.0, 90.0, 80.0), size=128, padding_ratio=1.2)


def _depth() -> np.ndarray:
    depth = np.full((96, 128), 600.0, np.float32)
    depth[:, 64:] = 650
    depth[:10] = 0
    return depth


def test_points_project_back_onto_their_pixels_whatever_the_depth():
    px = np.random.default_rng(0).uniform(20, 100, (50, 2))
    points = lift(px, A, _depth(), K, T)
    assert np.allclose(apply_homography(A, project(K, transform(T, points))), px, atol=1e-9)


def test_known_plane_gives_known_points():
    points_cam = transform(
        T, lift(apply_homography(A, np.array([[63.5, 47.5], [63.4, 47.5], [64.5, 47.5]])), A, _depth(), K, T)
    )
    assert np.allclose(points_cam, [[0, 0, 650], [-0.12, 0, 600], [1.3, 0, 650]], atol=1e-9)


def test_background_is_nan():
    points = lift(apply_homography(A, np.array([[50.0, 9.4], [50.0, 9.6]])), A, _depth(), K, T)
    assert np.isnan(points[0]).all()
    assert np.isfinite(points[1]).all()


def test_no_points_give_no_points():
    assert lift(np.zeros((0, 2)), A, _depth(), K, T).shape == (0, 3)


def test_point_outside_the_map_is_an_error_that_names_it():
    with pytest.raises(ValueError, match=r"template point \(-2.0, 40.0\) lies outside the 128 x 96 px depth map"):
        lift(apply_homography(A, np.array([[50.0, 40.0], [-2.0, 40.0]])), A, _depth(), K, T)
