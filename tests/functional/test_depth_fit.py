import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.functional.depth_fit import fit_depth
from pipeline.functional.rigid import rigid, rotation_angle_deg
from pipeline.stages.render.raycast import render_depth
from pipeline.synthetic.objects import make_object

K = np.array([[500.0, 0, 159.5], [0, 500.0, 119.5], [0, 0, 1]])
SIZE = (240, 320)
MESH = make_object(4)
DIAMETER = 150.0
TRUE = rigid(Rotation.from_euler("xyz", [40, 20, 10], degrees=True).as_matrix(), np.array([5.0, -4.0, 700.0]))


def render(T: np.ndarray) -> np.ndarray:
    return render_depth(MESH, K, T[None], SIZE)[0]


def measured(*, noise_mm: float = 0.0) -> np.ndarray:
    depth = render(TRUE)
    wall = np.where(depth > 0, depth, 1000.0)
    return wall + np.random.default_rng(0).normal(0, noise_mm, wall.shape) if noise_mm else wall


def off(T: np.ndarray) -> tuple[float, float]:
    angle = float(rotation_angle_deg(T[None, :3, :3], TRUE[None, :3, :3])[0])
    return float(np.linalg.norm(T[:3, 3] - TRUE[:3, 3])), angle


START = rigid(Rotation.from_euler("y", 3, degrees=True).as_matrix() @ TRUE[:3, :3], TRUE[:3, 3] * 1.03)


@pytest.mark.parametrize(("noise_mm", "most_mm", "most_deg"), [(0.0, 0.5, 0.3), (2.0, 1.0, 1.0)])
def test_pose_is_aligned_with_the_measured_surface(noise_mm: float, most_mm: float, most_deg: float):
    depth, mask = measured(noise_mm=noise_mm), render(TRUE) > 0
    ray = fit_depth(START, render, depth, mask, K, DIAMETER, rounds=0)
    np.testing.assert_array_equal(ray[:3, :3], START[:3, :3])
    assert off(ray)[0] < 0.3 * off(START)[0]
    fitted = fit_depth(START, render, depth, mask, K, DIAMETER, rounds=12)
    assert off(fitted)[0] < most_mm
    assert off(fitted)[1] < most_deg


def test_missing_depth_changes_nothing():
    mask = render(TRUE) > 0
    np.testing.assert_array_equal(fit_depth(START, render, np.zeros(SIZE), mask, K, DIAMETER, rounds=12), START)
    np.testing.assert_array_equal(fit_depth(START, render, measured(), ~mask, K, DIAMETER, rounds=12), START)


def test_an_occluder_inside_the_mask_does_not_draw_the_pose():
    depth, mask = measured(), render(TRUE) > 0
    depth[:, :150] = np.where(mask[:, :150], 500.0, depth[:, :150])
    assert (mask[:, :150].sum()) < 0.5 * mask.sum()
    assert off(fit_depth(START, render, depth, mask, K, DIAMETER, rounds=12))[0] < 1.5


def test_alignment_that_travels_far_is_not_taken():
    slope = np.broadcast_to(np.linspace(500, 900, SIZE[1])[None], SIZE).copy()
    fitted = fit_depth(START, render, slope, np.ones(SIZE, bool), K, DIAMETER, rounds=30)
    along = np.linalg.norm(fitted[:3, :3] - START[:3, :3])
    assert along < 0.3
