"""The route's geometry: poses in the plane of a crop, and from a template alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.presets import PAPER
from pipeline.functional import camera, rigid
from pipeline.hypotheses import select_distinct, template_pose
from pipeline.items.features import CropFeatures
from pipeline.items.online import Hypothesis, Query, TemplateView
from pipeline.items.poses import PoseSolution
from pipeline.method import SecondLook
from pipeline.route import Route
from pipeline.stages.solve.epnp import Epnp
from pipeline.stages.solve.poselib import Poselib

K = np.array([[600.0, 0.0, 310.0], [0.0, 580.0, 250.0], [0.0, 0.0, 1.0]])
T = rigid.rigid(rigid.look_at(np.array([300.0, 200.0, 250.0]))[:3, :3], np.array([250.0, -120.0, 700.0]))
BOX = (480.0, 90.0, 580.0, 200.0)
NOTHING = CropFeatures({}, torch.ones(8, 8, dtype=torch.bool))
CROPS = {
    "square": camera.square_crop(BOX, size=128, padding_ratio=1.2),
    "virtual": camera.virtual_crop(BOX, K, size=128, padding_ratio=1.2),
}


def solved(solve: Epnp | Poselib, A_crop_img: np.ndarray, *, noise_px: float = 0.0):
    points = np.random.default_rng(0).uniform(-60, 60, (80, 3))
    px = camera.project(K, rigid.transform(T, points)) + noise_px * np.random.default_rng(1).normal(size=(80, 2))
    seen = np.ones(80, bool)
    seen[::9] = False
    route = Route(replace(PAPER, solve=solve), Query(NOTHING, A_crop_img, K), bank=None)
    return route.solve_pose(np.where(seen[:, None], points, np.nan), px), seen, points, px


@pytest.mark.parametrize("crop", CROPS)
@pytest.mark.parametrize("plane", ["image", "crop"])
@pytest.mark.parametrize("solver", [Epnp, Poselib])
def test_exact_projections_give_the_exact_pose_in_either_plane(crop, plane, solver):
    solution, seen, _, _ = solved(solver(plane=plane), CROPS[crop])
    np.testing.assert_allclose(solution.T_cam_obj, T, atol=1e-5)  # mm, converged from another start
    assert np.array_equal(solution.inliers, seen)


def test_a_threshold_in_the_crop_is_of_crop_pixels_and_the_error_of_image_pixels():
    A = CROPS["square"]  # about one crop pixel per image pixel
    in_crop, _, points, px = solved(Epnp(plane="crop", threshold_px=2 * A[0, 0]), A, noise_px=1.0)
    in_image, *_ = solved(Epnp(threshold_px=2.0), A, noise_px=1.0)
    assert np.array_equal(in_crop.inliers, in_image.inliers)
    np.testing.assert_allclose(in_crop.T_cam_obj, in_image.T_cam_obj, atol=1e-3)
    error = camera.project(K, rigid.transform(in_crop.T_cam_obj, points)) - px
    rms = np.sqrt((error[in_crop.inliers] ** 2).sum(1).mean())
    assert in_crop.reprojection_px == pytest.approx(rms)
    assert in_image.reprojection_px == pytest.approx(rms, abs=1e-3)


@pytest.mark.parametrize("megapixels", [0.3, 4.0, 50.0, 200.0])
def test_a_larger_photograph_of_the_same_scene_keeps_its_inliers(megapixels):
    """Features locate points to a share of the crop, so the error in pixels grows with the image."""
    factor = (megapixels / 0.3) ** 0.5
    A_large = camera.resize_affine(factor)
    points = np.random.default_rng(0).uniform(-60, 60, (80, 3))
    noise = np.random.default_rng(1).normal(size=(80, 2))
    px = camera.apply_homography(A_large, camera.project(K, rigid.transform(T, points)) + 2.0 * noise)
    query = Query(NOTHING, CROPS["square"] @ np.linalg.inv(A_large), A_large @ K)
    found = Route(replace(PAPER, solve=Epnp(threshold_px=8.0)), query, bank=None).solve_pose(points, px)
    assert found.inliers.mean() > 0.95
    assert found.reprojection_px == pytest.approx(2.7 * factor, rel=0.1)
    assert np.linalg.norm(found.T_cam_obj[:3, 3] - T[:3, 3]) < 12  # mm, as at 0.3 megapixels


def view(A_crop_img: np.ndarray, T_cam_obj: np.ndarray) -> TemplateView:
    return TemplateView(NOTHING, A_crop_img, np.zeros((4, 4)), K, T_cam_obj)


def test_a_template_that_looks_the_same_in_a_turned_camera_gives_the_turned_pose():
    T_template = rigid.rigid(T[:3, :3], np.array([0.0, 0.0, 700.0]))
    K_virtual = np.array([[900.0, 0.0, 63.5], [0.0, 900.0, 63.5], [0.0, 0.0, 1.0]])
    turn = rigid.rotation_between(np.array([0.0, 0, 1]), np.array([0.4, -0.2, 1.0]))
    A_query, A_template = K_virtual @ turn.T @ np.linalg.inv(K), K_virtual @ np.linalg.inv(K)
    found = template_pose(Query(NOTHING, A_query, K), view(A_template, T_template))
    expected = rigid.rigid(turn @ T_template[:3, :3], turn @ T_template[:3, 3])
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_a_template_in_a_square_crop_keeps_its_place_and_its_size():
    T_template = rigid.rigid(T[:3, :3], np.array([3.0, -5.0, 700.0]))
    A_template = camera.square_crop((250.0, 200.0, 370.0, 300.0), size=128, padding_ratio=1.2)
    found = template_pose(Query(NOTHING, CROPS["square"], K), view(A_template, T_template))
    at = [
        camera.apply_homography(A, camera.project(K, pose[:3, 3]))
        for A, pose in ((A_template, T_template), (CROPS["square"], found))
    ]
    np.testing.assert_allclose(*at, atol=1e-9)
    assert found[2, 3] == pytest.approx(700 * CROPS["square"][0, 0] / A_template[0, 0])


def hypothesis(T_cam_obj: np.ndarray) -> Hypothesis:
    points = np.random.default_rng(0).uniform(-60, 60, (80, 3))
    return Hypothesis(0, 1.0, points_obj=points, solution=PoseSolution(T_cam_obj, np.ones(80, bool), 0.5))


@pytest.mark.parametrize(("apart_px", "chosen"), [(5.0, [0, 2]), (0.0, [0, 1]), (128.0, [0, 4])])
def test_hypotheses_that_would_render_nearly_the_same_view_are_selected_once(apart_px, chosen):
    turned = T @ rigid.rigid(rigid.rotation_between(np.array([0.0, 0, 1]), np.array([1.0, 0, 1])), np.zeros(3))
    shifted, behind = T.copy(), T.copy()
    shifted[0, 3] += 3.0  # mm, about 3 px of 128
    behind[2, 3] = -500.0
    poses = [hypothesis(pose) for pose in (T, shifted, turned, shifted)] + [hypothesis(behind)]
    found = select_distinct(poses, CROPS["square"] @ K, count=2, apart_px=apart_px)
    assert [poses.index(h) for h in found] == chosen


def test_of_hypotheses_without_a_pose_none_looks_like_another():
    without = [Hypothesis(k, 1.0) for k in range(3)]
    assert select_distinct(without, CROPS["square"] @ K, count=2, apart_px=5.0) == without[:2]
    route = Route(replace(PAPER, second_look=SecondLook(hypotheses=2)), Query(NOTHING, CROPS["square"], K), bank=None)
    assert [h.template_id for h in route.look_again(without)] == [0, 1, 2]
