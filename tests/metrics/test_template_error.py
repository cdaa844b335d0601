import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.functional.rigid import look_at, rigid
from pipeline.metrics.template_error import template_error

NONE = np.eye(4)[None]
FRONT = look_at(np.array([0.0, -600.0, 100.0]))


def rotate(T: np.ndarray, rotvec_deg: tuple[float, float, float]) -> np.ndarray:
    return rigid(Rotation.from_rotvec(np.deg2rad(rotvec_deg)).as_matrix(), np.zeros(3)) @ T


def test_15_degrees_by_the_papers_formula_are_18_geodesic():
    for angle in (5.0, 18.4, 90.0, 180.0):
        error = template_error(rotate(FRONT, (angle, 0, 0)), FRONT, NONE)
        assert error.geodesic == pytest.approx(angle, abs=1e-6)
        expected = np.rad2deg(np.arccos((1 + 2 * np.cos(np.deg2rad(angle))) / 3))
        assert error.vectorised == pytest.approx(expected, abs=1e-4)
    assert template_error(rotate(FRONT, (18.4, 0, 0)), FRONT, NONE).vectorised == pytest.approx(15.0, abs=0.05)


def test_inplane_rotation_keeps_the_direction():
    spun = rotate(FRONT, (0, 0, 40))
    error = template_error(spun, FRONT, NONE)
    assert error.geodesic == pytest.approx(40, abs=1e-6)
    assert error.direction == pytest.approx(0, abs=1e-6)


def test_orbiting_the_object_changes_the_direction_by_its_angle():
    side = look_at(600 * np.array([np.sin(0.5), -np.cos(0.5), 0.0]))
    front = look_at(np.array([0.0, -600.0, 0.0]))
    assert template_error(side, front, NONE).direction == pytest.approx(np.rad2deg(0.5), abs=1e-6)


def test_symmetric_views_have_no_error():
    half_turn = rigid(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    symmetries = np.stack([np.eye(4), half_turn])
    error = template_error(FRONT @ half_turn, FRONT, symmetries)
    assert max(error.geodesic, error.direction, error.vectorised) < 1e-5
