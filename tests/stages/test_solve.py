import sys

import cv2
import numpy as np
import pytest

from pipeline.errors import BadInput, NoPose
from pipeline.functional.camera import project
from pipeline.functional.rigid import inverse, rigid, rotation_angle_deg, transform
from pipeline.items.poses import PoseSolution
from pipeline.spec import build
from pipeline.stages.solve.epnp import Epnp
from pipeline.stages.solve.poselib import Poselib

K = np.array([[572.4, 0.0, 325.3], [0.0, 573.6, 242.0], [0.0, 0.0, 1.0]])
T = rigid(cv2.Rodrigues(np.array([0.9, -0.4, 0.3]))[0], np.array([60.0, -40.0, 900.0]))
SOLVERS = pytest.mark.parametrize("solve", [Epnp(), Poselib()], ids=["epnp", "poselib"])


def _points(n: int = 200, flat: float = 1.0) -> np.ndarray:
    return np.random.default_rng(0).uniform(-60, 60, (n, 3)) * [1, 1, flat]


def _observed(points: np.ndarray, *, noise: float = 0.0, outliers: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(1)
    px = (
        project(K, transform(T, points)) + rng.normal(0, noise, (len(points), 2))
        if noise
        else project(K, transform(T, points))
    )
    wrong = int(outliers * len(points))
    px[:wrong] = rng.uniform((200, 150), (450, 330), (wrong, 2))
    return px


def _errors(solution: PoseSolution) -> tuple[float, float]:
    """Rotation (degrees) and translation (mm) off the truth."""
    return (
        float(rotation_angle_deg(solution.T_cam_obj[None, :3, :3], T[None, :3, :3])[0]),
        float(np.linalg.norm(solution.T_cam_obj[:3, 3] - T[:3, 3])),
    )


@SOLVERS
def test_exact_projections_give_the_exact_pose(solve):
    solution = solve(_points(), _observed(_points()), K)
    assert np.abs(solution.T_cam_obj - T).max() < 1e-6
    assert solution.inliers.all()
    assert solution.reprojection_px < 1e-6


@SOLVERS
def test_pose_follows_the_frame_of_the_object(solve):
    T_new_obj = rigid(cv2.Rodrigues(np.array([0.2, 1.0, -0.5]))[0], np.array([5.0, 3.0, -8.0]))
    points = transform(T_new_obj, _points())
    solution = solve(points, _observed(_points()), K)
    assert np.abs(solution.T_cam_obj - T @ inverse(T_new_obj)).max() < 1e-5  # mm, converged from another start


@SOLVERS
def test_half_of_the_matches_wrong_leaves_the_pose(solve):
    px = _observed(_points(), noise=0.5, outliers=0.5)
    solution = solve(_points(), px, K)
    rotation_deg, translation_mm = _errors(solution)
    assert rotation_deg < 0.6  # noise alone gives 0.1; the few chance matches within 8 px pull as hard as true ones
    assert translation_mm < 2.0
    assert solution.inliers[100:].all()
    assert solution.inliers[:100].mean() < 0.05  # a disc of 8 px in 250 x 180 holds 0.4 % of chance points
    assert np.array_equal(solution.T_cam_obj, solve(_points(), px.copy(), K).T_cam_obj)


@SOLVERS
def test_flat_object_is_solved_as_well(solve):
    solution = solve(_points(flat=0.0), _observed(_points(flat=0.0), noise=0.5, outliers=0.3), K)
    rotation_deg, translation_mm = _errors(solution)
    assert rotation_deg < 0.5
    assert translation_mm < 4.0


def test_inliers_and_error_are_those_of_the_pose_returned():
    points = _points()
    px = _observed(points, noise=1.0, outliers=0.4)
    for solve in (Epnp(), Epnp(refine=False), Poselib()):
        solution = solve(points, px, K)
        error = np.linalg.norm(project(K, transform(solution.T_cam_obj, points)) - px, axis=1)
        assert np.array_equal(solution.inliers, error < 8)
        assert solution.reprojection_px == pytest.approx(np.sqrt(np.mean(error[error < 8] ** 2)))
        R = solution.T_cam_obj[:3, :3]
        assert np.allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) > 0


def test_polish_lowers_the_error():
    points, px = _points(), _observed(_points(), noise=2.0, outliers=0.3)
    assert Epnp().__call__(points, px, K).reprojection_px < Epnp(refine=False)(points, px, K).reprojection_px


def test_seed_changes_the_draws_of_a_hard_set_and_nothing_else_does():
    points, px = _points(), _observed(_points(), noise=1.0, outliers=0.6)
    poses = [Epnp(seed=seed, refine=False)(points, px, K).T_cam_obj for seed in (0, 1, 0)]
    assert not np.array_equal(poses[0], poses[1])
    cv2.setRNGSeed(123)
    assert np.array_equal(poses[0], poses[2])


@SOLVERS
def test_points_that_are_not_finite_are_no_inliers(solve):
    points, px = _points(), _observed(_points())
    points[3] = np.nan
    px[7] = np.inf
    solution = solve(points, px, K)
    assert np.flatnonzero(~solution.inliers).tolist() == [3, 7]


@SOLVERS
def test_too_few_points_say_how_many(solve):
    with pytest.raises(NoPose, match="solve: 5 correspondences, PnP needs 6"):
        solve(_points(5), _observed(_points(5)), K)
    with pytest.raises(NoPose, match="solve: 0 correspondences, PnP needs 6"):
        solve(np.full((9, 3), np.nan), np.zeros((9, 2)), K)


@SOLVERS
def test_chance_matches_and_sets_without_extent_have_no_pose(solve):
    rng = np.random.default_rng(2)
    with pytest.raises(NoPose, match=r"solve: .* of 40 points within 8 px"):
        solve(_points(40), rng.uniform(0, 4000, (40, 2)), K)
    for points, px in (
        (np.zeros((20, 3)), rng.uniform(0, 400, (20, 2))),
        (np.arange(20.0)[:, None] * [1, 2, 3], rng.uniform(0, 400, (20, 2))),
    ):
        with pytest.raises(NoPose, match="solve: "):
            solve(points, px, K)


@SOLVERS
def test_no_pose_puts_points_behind_the_camera(solve):
    behind = rigid(T[:3, :3], np.array([60.0, -40.0, -900.0]))
    px = project(K, transform(behind, _points()))
    try:
        solution = solve(_points(), px, K)
    except NoPose:
        return
    assert (transform(solution.T_cam_obj, _points()[solution.inliers])[:, 2] > 0).all()


def test_missing_poselib_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "poselib", None)
    with pytest.raises(
        BadInput, match=r"solve=poselib: found poselib, which is not installed, needs pip install poselib"
    ):
        Poselib()


def test_options_out_of_range_name_the_field():
    with pytest.raises(BadInput, match=r"solve.confidence: found 1.0, needs less than 1"):
        build(Epnp, {"confidence": 1.0}, where="solve")
    with pytest.raises(BadInput, match=r"solve.min_inliers: found 3, needs greater than or equal to 4"):
        build(Epnp, {"min_inliers": 3}, where="solve")


def test_refitting_trusts_near_matches_more_than_those_at_the_threshold():
    points, rng = _points(), np.random.default_rng(4)
    px = _observed(points, noise=0.3)
    px[:60] += rng.uniform(1.5, 4.0, (60, 2))  # wrong by less than the threshold, all to one side
    solved = Poselib(threshold_px=5.0)(points, px, K).T_cam_obj

    def off_mm(found: np.ndarray) -> float:
        return float(np.linalg.norm(transform(found, points) - transform(T, points), axis=1).max())

    refitted = Poselib(refit_px=0.7).refit(points, px, K, solved)
    assert off_mm(refitted) < 0.5 * off_mm(solved)


def test_without_near_matches_the_pose_stays():
    points = _points()
    px = _observed(points) + 5.0
    assert np.array_equal(Poselib(refit_px=0.01).refit(points, px, K, T), T)


def test_only_poselib_with_a_loss_refits():
    assert [solve.refits for solve in (Epnp(), Poselib(), Poselib(refit_px=0.7))] == [False, False, True]


def test_refitting_is_left_out_of_keys_where_it_is_off():
    assert "refit_px" not in Poselib().recipe()
    assert Poselib(refit_px=1.0).recipe()["refit_px"] == 1.0
