"""Known values of the correspondence error."""

import numpy as np
import pytest

from pipeline.functional.camera import project
from pipeline.functional.rigid import rigid, rotation_between, transform
from pipeline.metrics.correspondence_error import correspondence_errors_mm

K = np.array([[600.0, 0, 320], [0, 500.0, 240], [0, 0, 1]])
T_GT = rigid(rotation_between(np.array([1.0, 0, 0]), np.array([0.3, 0.5, 0.8])), np.array([40.0, -20.0, 800.0]))
POINTS = np.random.default_rng(3).uniform(-50, 50, (40, 3))
NONE = np.eye(4)[None]


def test_displacement_across_the_view_is_the_error():
    px = project(K, transform(T_GT, POINTS))
    across = T_GT[:3, :3].T @ np.array([3.0, 4.0, 0.0])
    np.testing.assert_allclose(correspondence_errors_mm(POINTS + across, px, K, T_GT, NONE), 5.0, atol=1e-9)
    np.testing.assert_allclose(correspondence_errors_mm(POINTS, px, K, T_GT, NONE), 0.0, atol=1e-9)


def test_displacement_along_the_ray_is_no_error():
    in_camera = transform(T_GT, POINTS)
    nearer = transform(np.linalg.inv(T_GT), 0.9 * in_camera)
    assert correspondence_errors_mm(nearer, project(K, in_camera), K, T_GT, NONE).max() < 1e-9


def test_best_symmetry_counts_and_nan_is_dropped():
    turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    px = project(K, transform(T_GT @ turn, POINTS))
    points = np.concatenate([POINTS, np.full((1, 3), np.nan)])
    px = np.concatenate([px, [[0.0, 0.0]]])
    errors = correspondence_errors_mm(points, px, K, T_GT, np.stack([np.eye(4), turn]))
    assert errors.shape == (40,)
    assert errors == pytest.approx(0, abs=1e-9)
    assert np.median(correspondence_errors_mm(points, px, K, T_GT, NONE)) > 10
