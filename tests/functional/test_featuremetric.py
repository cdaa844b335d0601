import numpy as np
import pytest
import torch

from pipeline.functional import camera, featuremetric
from pipeline.functional.featuremetric import FeatureField, RobustLoss, Surface
from pipeline.functional.rigid import look_at, transform

H, W, C = 18, 22, 5
CELLS = np.array([[1.0, 0.0, 0.2], [0.0, 1.0, -0.1], [1e-3, -2e-3, 1.0]])  # a homography, as for a rotated crop camera
K_CELL = CELLS @ np.array([[60.0, 0, 10.5], [0, 62.0, 8.5], [0, 0, 1]])
T = look_at(np.array([300.0, 200.0, 250.0]))
LOSSES = pytest.mark.parametrize("alpha", [-5.0, -2.0, 0.0])


def smooth_map(seed: int) -> np.ndarray:
    """Sine waves much longer than a cell."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:H, :W]
    waves = [np.sin(a * x + b * y + c) for a, b, c in rng.uniform(-0.3, 0.3, (C, 3))]
    return np.stack(waves, axis=-1).astype(np.float32) + 0.5


def scene(*, normalize: bool) -> tuple[Surface, FeatureField]:
    rng = np.random.default_rng(0)
    points, d = rng.uniform(-40, 40, (60, 3)), rng.normal(size=(60, C)).astype(np.float32)
    d = featuremetric.l2_normalize(d) if normalize else d
    field = FeatureField.from_map(smooth_map(1), np.ones((H, W), bool), normalize=normalize)
    return Surface(points, d, np.full(60, 2.0)), field


def test_derivatives_of_a_projection_equal_finite_differences():
    points = np.random.default_rng(0).uniform(-40, 40, (20, 3))
    centre = transform(T, points).mean(0)
    _, by_xi = featuremetric.project_cells(K_CELL, transform(T, points), centre)
    for k in range(6):
        h = 1e-4 * np.eye(6)[k]
        ends = [
            featuremetric.project_cells(
                K_CELL, transform(featuremetric.apply_increment(T, centre, sign * h), points), np.zeros(3)
            )[0]
            for sign in (1, -1)
        ]
        np.testing.assert_allclose(by_xi[:, :, k], (ends[0] - ends[1]) / 2e-4, rtol=1e-5, atol=1e-7)


@LOSSES
@pytest.mark.parametrize("normalize", [False, True])
def test_gradient_of_the_cost_equals_finite_differences(alpha, normalize):
    surface, field = scene(normalize=normalize)
    robust = RobustLoss(alpha, 0.7)
    _, _, gradient, centre = featuremetric.normal_equations(surface, field, K_CELL, T, robust)
    for k in range(6):
        h = (1e-3 if k < 3 else 1e-5) * np.eye(6)[k]  # mm and radians: about 1e-4 cells, above float32 rounding
        ends = [
            featuremetric.normal_equations(
                surface, field, K_CELL, featuremetric.apply_increment(T, centre, s * h), robust
            )[0]
            for s in (1, -1)
        ]
        # a few points cross between squares of cells, where bilinear interpolation has a kink
        assert gradient[k] == pytest.approx((ends[0] - ends[1]) / (2 * h[k]), rel=0.02, abs=2e-2 * abs(gradient).max())


def test_linear_map_is_sampled_exactly():
    y, x = np.mgrid[:H, :W].astype(np.float32)
    field = FeatureField.from_map(np.stack([x, 2 * y, x - y], axis=-1), np.ones((H, W), bool))
    xy = np.random.default_rng(0).uniform(0, (W - 1, H - 1), (50, 2))
    true = np.stack([xy[:, 0], 2 * xy[:, 1], xy[:, 0] - xy[:, 1]], axis=1)
    asked = np.random.default_rng(1).normal(size=(50, 3)).astype(np.float32)
    found = featuremetric.residuals_at(field, xy, asked)
    J = np.array([[1.0, 0.0], [0.0, 2.0], [1.0, -1.0]])
    np.testing.assert_allclose(found.squared, np.square(true - asked).sum(1), rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(found.half_gradient, (true - asked) @ J, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(found.half_hessian, np.broadcast_to(J.T @ J, (50, 2, 2)), rtol=1e-4, atol=1e-3)


@LOSSES
def test_weight_is_twice_the_derivative_of_the_loss(alpha):
    robust, squared = RobustLoss(alpha, 0.4), np.linspace(0, 3, 31)
    slope = (robust.cost(squared + 1e-6) - robust.cost(squared - 1e-6)) / 1e-6
    np.testing.assert_allclose(robust.weight(squared), slope, rtol=1e-6)
    assert robust.cost(np.zeros(1)) == 0


def test_points_out_of_view_have_the_unobserved_cost_and_no_gradient():
    surface, field = scene(normalize=True)
    away = T.copy()
    for shift in ([900.0, 0, 0], [0, 0, -3000.0]):  # outside the map, behind the camera
        away[:3, 3] = T[:3, 3] + shift
        squared, seen = featuremetric.squared_residuals(surface, field, K_CELL, away)
        assert not seen.any()
        assert (squared == surface.unobserved).all()
        cost, H_, g, _ = featuremetric.normal_equations(surface, field, K_CELL, away, RobustLoss(-2.0, 0.5))
        assert cost == pytest.approx(RobustLoss(-2.0, 0.5).cost(np.array([2.0]))[0])
        assert not H_.any()
        assert not g.any()
        same = featuremetric.descend(surface, field, K_CELL, away, RobustLoss(-2.0, 0.5), iterations=5)
        assert np.array_equal(same, away)


@LOSSES
def test_no_step_increases_the_cost(alpha):
    surface, field = scene(normalize=True)
    robust, costs, pose = RobustLoss(alpha, 0.5), [], T
    for _ in range(8):
        costs.append(featuremetric.normal_equations(surface, field, K_CELL, pose, robust)[0])
        pose = featuremetric.descend(surface, field, K_CELL, pose, robust, iterations=1)
    assert (np.diff(costs) <= 0).all()
    assert costs[-1] < costs[0]


def test_smoothing_uses_only_the_foreground():
    mask = np.zeros((H, W), bool)
    mask[5:12, 6:15] = True
    features = np.where(mask[..., None], np.float32(3.0), np.float32(-100.0)) * np.ones(C, np.float32)
    for sigma in (0.0, 1.0, 2.5):
        found = featuremetric.smooth_foreground(features, mask, sigma_cells=sigma)
        np.testing.assert_allclose(found[4:13, 5:16], 3.0, rtol=1e-5)  # and extends it beyond the edge
    varied = smooth_map(2)
    assert np.array_equal(featuremetric.smooth_foreground(varied, mask, sigma_cells=0.0)[mask], varied[mask])


def test_cell_affine_inverts_cell_to_px():
    xy = np.random.default_rng(0).uniform(0, 60, (9, 2))
    px = camera.cell_to_px(torch.from_numpy(xy), size=420, cells=30).numpy()
    np.testing.assert_allclose(camera.apply_homography(camera.cell_affine(size=420, cells=30), px), xy, atol=1e-9)
