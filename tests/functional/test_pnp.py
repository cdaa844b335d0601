import cv2
import numpy as np

from pipeline.functional.camera import project
from pipeline.functional.pnp import least_squares_pose, polish, reprojection_error_px, truncated_cost
from pipeline.functional.rigid import rigid, transform

K = np.array([[600.0, 0.0, 320.0], [0.0, 610.0, 240.0], [0.0, 0.0, 1.0]])
T = rigid(cv2.Rodrigues(np.array([0.4, -0.7, 0.2]))[0], np.array([30.0, -20.0, 800.0]))


def _points(n: int = 60) -> np.ndarray:
    return np.random.default_rng(0).uniform(-60, 60, (n, 3))


def _perturb(T_cam_obj: np.ndarray, angle: float, dz: float) -> np.ndarray:
    return rigid(cv2.Rodrigues(np.array([angle, angle, 0.0]))[0] @ T_cam_obj[:3, :3], T_cam_obj[:3, 3] + [0, 0, dz])


def test_least_squares_converges_to_the_exact_pose():
    px = project(K, transform(T, _points()))
    assert np.abs(least_squares_pose(_points(), px, K, _perturb(T, 0.1, 30.0)) - T).max() < 1e-6  # mm; converged


def test_polish_never_increases_the_truncated_cost():
    rng = np.random.default_rng(1)
    px = project(K, transform(T, _points())) + rng.normal(0, 1, (60, 2))
    px[:20] += rng.uniform(-80, 80, (20, 2))
    for angle in (0.0, 0.01, 0.05, 1.5):
        start = _perturb(T, angle, 100 * angle)
        before = truncated_cost(reprojection_error_px(_points(), px, K, start), threshold_px=8.0)
        end = polish(_points(), px, K, start, threshold_px=8.0)
        assert truncated_cost(reprojection_error_px(_points(), px, K, end), threshold_px=8.0) <= before


def test_a_point_behind_the_camera_has_an_infinite_error():
    px = project(K, transform(T, _points(2)))
    behind = rigid(T[:3, :3], np.array([0.0, 0.0, -800.0]))
    assert np.isinf(reprojection_error_px(_points(2), px, K, behind)).all()
