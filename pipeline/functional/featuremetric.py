"""Featuremetric pose refinement: move object points until the query shows their descriptors where they project.

The query's map is sampled bilinearly at positions (x, y) in cells. Points that project outside the map, outside its
mask or behind the camera have no sample. Residuals are computed from inner products only; those of the map with itself
are precomputed, so a step costs one product of each point's descriptor with the four cells around it.

An increment xi = (v, omega), in mm and radians, rotates about the points' centroid c in the camera frame: p -> c +
exp(omega) (p - c) + v. It multiplies T_cam_obj from the left and keeps rotation and translation decoupled.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from pipeline.functional.rigid import nearest_rotation, rigid, transform

_FILL_SIGMA_CELLS = 0.7  # blur that extends the foreground's descriptors beyond its edge
_MIN_DAMPING, _FIRST_DAMPING, _MAX_DAMPING = 1e-7, 1e-3, 1e6
_MIN_DECREASE = 1e-4  # stop when a step promises less than this relative decrease of the cost
_MIN_SCALE = 0.05  # of the descriptors' length: residuals of an exact fit are rounding errors
_CORNERS = ((0, 0), (0, 1), (1, 0), (1, 1))  # row, column


@dataclass(frozen=True, eq=False)
class FeatureField:
    """A query's descriptors, prepared for bilinear sampling. n squares of four neighbouring cells, in row-major order.

    ``cells``: the descriptors; ``gram``: inner products of the four of a square. ``mask``: foreground cells.
    ``normalize``: scale each sampled descriptor to unit length.
    """

    cells: Float32[np.ndarray, "cells c"]
    gram: Float32[np.ndarray, "n 4 4"]
    mask: Bool[np.ndarray, "h w"]
    normalize: bool

    @classmethod
    def from_map(
        cls, values: Float32[np.ndarray, "h w c"], mask: Bool[np.ndarray, "h w"], *, normalize: bool = False
    ) -> FeatureField:
        """The field of a feature map and its foreground."""
        return cls(values.reshape(-1, values.shape[-1]), _corner_products(values), mask, normalize)

    def read_corners(self, square: Int[np.ndarray, " m"]) -> Float32[np.ndarray, "m 4 c"]:
        """Descriptors of the four cells of some squares."""
        width = self.mask.shape[1]
        first = square // (width - 1) * width + square % (width - 1)
        return self.cells.take(first[:, None] + [i * width + j for i, j in _CORNERS], axis=0)


def _corner_products(v: Float32[np.ndarray, "h w c"]) -> Float32[np.ndarray, "n 4 4"]:
    """Inner products of the four cells of each square; neighbouring squares share most of them."""

    def multiply(a: Float32[np.ndarray, "y x c"], b: Float32[np.ndarray, "y x c"]) -> Float32[np.ndarray, "y x"]:
        return np.einsum("yxc,yxc->yx", a, b)

    own, across, down = multiply(v, v), multiply(v[:, :-1], v[:, 1:]), multiply(v[:-1], v[1:])
    falling, rising = multiply(v[:-1, :-1], v[1:, 1:]), multiply(v[:-1, 1:], v[1:, :-1])
    left, right = down[:, :-1], down[:, 1:]
    rows = (
        (own[:-1, :-1], across[:-1], left, falling),
        (across[:-1], own[:-1, 1:], rising, right),
        (left, rising, own[1:, :-1], across[1:]),
        (falling, right, across[1:], own[1:, 1:]),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2).reshape(-1, 4, 4)


@dataclass(frozen=True, eq=False)
class Surface:
    """Object points (mm) with descriptors.

    ``unobserved``: the squared residual of a point without a sample: its mean over the query's foreground cells.
    """

    points_obj: Float[np.ndarray, "m 3"]
    descriptors: Float32[np.ndarray, "m c"]
    unobserved: Float[np.ndarray, " m"]


@dataclass(frozen=True, eq=False)
class Residuals:
    """Squared residuals of sampled points, with half their gradient and half their Gauss-Newton Hessian by (x, y)."""

    squared: Float[np.ndarray, " m"]
    half_gradient: Float[np.ndarray, "m 2"]
    half_hessian: Float[np.ndarray, "m 2 2"]


@dataclass(frozen=True, eq=False)
class RobustLoss:
    """The general robust loss of Barron, CVPR 2019, Eq. 9, for ``alpha`` < 2.

    ``alpha`` 0: Cauchy; -2: Geman-McClure; smaller values saturate earlier. ``scale``: residual at which it bends.
    """

    alpha: float
    scale: float

    def cost(self, squared: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """Loss of squared residuals; about squared / (2 scale^2) for small ones."""
        x, b = squared / self.scale**2, 2.0 - self.alpha
        if self.alpha == 0:
            return np.log1p(x / 2)
        return b / self.alpha * ((x / b + 1) ** (self.alpha / 2) - 1)

    def weight(self, squared: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """Weights of iteratively reweighted least squares: twice the derivative of the loss by ``squared``."""
        x, b = squared / self.scale**2, 2.0 - self.alpha
        return (x / b + 1) ** (self.alpha / 2 - 1) / self.scale**2


def smooth_foreground(
    features: Float32[np.ndarray, "h w c"], mask: Bool[np.ndarray, "h w"], *, sigma_cells: float
) -> Float32[np.ndarray, "h w c"]:
    """Feature map blurred with a Gaussian over foreground cells only, and extended beyond the foreground's edge.

    ``sigma_cells`` 0: foreground cells stay unchanged. Cells far from the foreground are 0.
    """
    sigma = sigma_cells or _FILL_SIGMA_CELLS
    rows, columns = (_gaussian_matrix(n, sigma) for n in mask.shape)
    weight = rows @ mask.astype(np.float32) @ columns
    total = np.tensordot(rows, features * mask[..., None], axes=1)
    total = np.matmul(columns, total)
    mean = total / np.maximum(weight, 1e-6)[..., None]
    return mean if sigma_cells else np.where(mask[..., None], features, mean)


def _gaussian_matrix(n: int, sigma: float) -> Float32[np.ndarray, "n n"]:
    distance = np.arange(n)[:, None] - np.arange(n)
    return np.exp(-0.5 * (distance / sigma) ** 2).astype(np.float32)


def residuals_at(
    field: FeatureField, xy: Float[np.ndarray, "m 2"], descriptors: Float32[np.ndarray, "m c"]
) -> Residuals:
    """Residuals F(x, y) - d between the field at positions inside the map and the points' descriptors.

    Derivatives are per cell. With weights W (value, d/dx and d/dy of bilinear interpolation) over the four corner
    descriptors C, f = W C, so the products f f^T = W (C C^T) W^T and f d = W (C d) suffice.
    """
    h, w = field.mask.shape
    corner = np.clip(np.floor(xy).astype(np.int64), 0, (w - 2, h - 2))
    a, b = (xy - corner).T
    square = corner[:, 1] * (w - 1) + corner[:, 0]
    value = [(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b]
    by_x, by_y = [b - 1, 1 - b, -b, b], [a - 1, -a, 1 - a, a]
    W = np.stack([np.stack(rows, axis=1) for rows in (value, by_x, by_y)], axis=1)
    ff = np.matmul(np.matmul(W, field.gram[square]), W.swapaxes(1, 2))
    Cd = np.matmul(field.read_corners(square), descriptors[:, :, None]).astype(np.float64)
    fd = np.matmul(W, Cd)[:, :, 0]
    dd = np.square(descriptors, dtype=np.float64).sum(1)
    if field.normalize:
        ff, fd = _normalize_products(ff, fd)
    squared = np.maximum(ff[:, 0, 0] + dd - 2 * fd[:, 0], 0)
    return Residuals(squared, ff[:, 0, 1:] - fd[:, 1:], ff[:, 1:, 1:])


def _normalize_products(
    ff: Float[np.ndarray, "m 3 3"], fd: Float[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, "m 3 3"], Float[np.ndarray, "m 3"]]:
    """The same products for f / |f| in place of f: its derivatives lose their component along f."""
    power = np.maximum(ff[:, 0, 0], np.finfo(np.float32).tiny)
    length, along = np.sqrt(power), ff[:, 0, 1:] / power[:, None]
    unit_ff = np.zeros_like(ff)
    unit_ff[:, 0, 0] = 1
    unit_ff[:, 1:, 1:] = ff[:, 1:, 1:] / power[:, None, None] - along[:, :, None] * along[:, None]
    unit_fd = fd / length[:, None]
    unit_fd[:, 1:] -= unit_fd[:, :1] * along
    return unit_ff, unit_fd


def project_cells(
    K_cell: Float[np.ndarray, "3 3"], points_cam: Float[np.ndarray, "m 3"], centre_cam: Float[np.ndarray, " 3"]
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2 6"]]:
    """Positions (x, y) in cells and their derivatives by the increment xi; NaN for points behind the camera.

    ``K_cell`` projects the camera frame to cells: the camera matrix followed by an affine map or a homography.
    """
    front = (points_cam[:, 2] > 0) & (points_cam @ K_cell[2] > 0)
    p = np.where(front[:, None], points_cam, np.nan)
    q = p @ K_cell.T
    xy = q[:, :2] / q[:, 2:]
    by_point = (K_cell[:2] - xy[:, :, None] * K_cell[2]) / q[:, 2:, None]
    arm = (p - centre_cam)[:, None]
    return xy, np.concatenate([by_point, np.cross(arm, by_point)], axis=2)  # row . (omega x arm) = omega . (arm x row)


def apply_increment(
    T_cam_obj: Float[np.ndarray, "4 4"], centre_cam: Float[np.ndarray, " 3"], xi: Float[np.ndarray, " 6"]
) -> Float[np.ndarray, "4 4"]:
    """T_cam_obj after the increment xi = (v in mm, omega in radians) about ``centre_cam`` (camera frame, mm)."""
    R_increment = cv2.Rodrigues(xi[3:])[0]
    R = nearest_rotation(R_increment @ T_cam_obj[:3, :3])
    return rigid(R, R_increment @ (T_cam_obj[:3, 3] - centre_cam) + centre_cam + xi[:3])


def squared_residuals(
    surface: Surface, field: FeatureField, K_cell: Float[np.ndarray, "3 3"], T_cam_obj: Float[np.ndarray, "4 4"]
) -> tuple[Float[np.ndarray, " m"], Bool[np.ndarray, " m"]]:
    """Squared residual of every point (``unobserved`` where there is no sample), and which points have a sample."""
    xy, _ = project_cells(K_cell, transform(T_cam_obj, surface.points_obj), np.zeros(3))
    observed = in_foreground(field, xy)
    squared = surface.unobserved.copy()
    squared[observed] = residuals_at(field, xy[observed], surface.descriptors[observed]).squared
    return squared, observed


def in_foreground(field: FeatureField, xy: Float[np.ndarray, "m 2"]) -> Bool[np.ndarray, " m"]:
    """Which positions lie in a foreground cell and inside the grid of cell centres."""
    h, w = field.mask.shape
    with np.errstate(invalid="ignore"):
        inside = np.asarray(((xy >= 0) & (xy <= (w - 1, h - 1))).all(1))
    column, row = np.where(inside[:, None], np.floor(xy + 0.5), 0).astype(np.int64).T
    return inside & field.mask[row, column]


def normal_equations(
    surface: Surface,
    field: FeatureField,
    K_cell: Float[np.ndarray, "3 3"],
    T_cam_obj: Float[np.ndarray, "4 4"],
    robust: RobustLoss,
) -> tuple[float, Float[np.ndarray, "6 6"], Float[np.ndarray, " 6"], Float[np.ndarray, " 3"]]:
    """Mean robust cost over all points, its Gauss-Newton matrix and gradient by xi, and the increment's centre (mm).

    A point without a sample costs its ``unobserved`` residual, so that no pose gains by moving points out of sight.
    """
    points_cam = transform(T_cam_obj, surface.points_obj)
    centre = points_cam.mean(0)
    xy, by_xi = project_cells(K_cell, points_cam, centre)
    observed = in_foreground(field, xy)
    residuals = residuals_at(field, xy[observed], surface.descriptors[observed])
    squared = surface.unobserved.copy()
    squared[observed] = residuals.squared
    weight = robust.weight(residuals.squared) / len(squared)
    by_xi = by_xi[observed]
    gradient_xy = (residuals.half_gradient * weight[:, None]).reshape(-1)
    hessian_J = np.matmul(residuals.half_hessian * weight[:, None, None], by_xi).reshape(-1, 6)
    J = by_xi.reshape(-1, 6)
    return float(robust.cost(squared).mean()), J.T @ hessian_J, J.T @ gradient_xy, centre


def descend(
    surface: Surface,
    field: FeatureField,
    K_cell: Float[np.ndarray, "3 3"],
    T_cam_obj: Float[np.ndarray, "4 4"],
    robust: RobustLoss,
    *,
    iterations: int,
) -> Float[np.ndarray, "4 4"]:
    """T_cam_obj after at most ``iterations`` Levenberg-Marquardt steps; only steps that lower the mean cost are taken.

    Marquardt's damping with the matrix's diagonal: times 10 after a rejected step, divided by 10 after an accepted
    one. Stops when the next step promises too small a decrease.
    """
    damping = _FIRST_DAMPING
    cost, H, g, centre = normal_equations(surface, field, K_cell, T_cam_obj, robust)
    for _ in range(iterations):
        diagonal = np.diag(H)
        if damping > _MAX_DAMPING or not diagonal.min() > 0:
            break
        step = np.linalg.solve(H + damping * np.diag(diagonal), -g)
        if -(g + H @ step / 2) @ step < _MIN_DECREASE * cost:
            break
        T_next = apply_increment(T_cam_obj, centre, step)
        after = normal_equations(surface, field, K_cell, T_next, robust)
        if after[0] < cost:
            T_cam_obj, (cost, H, g, centre), damping = T_next, after, max(damping / 10, _MIN_DAMPING)
        else:
            damping *= 10
    return T_cam_obj


def robust_scale(
    surface: Surface, field: FeatureField, K_cell: Float[np.ndarray, "3 3"], T_cam_obj: Float[np.ndarray, "4 4"]
) -> float:
    """Median residual length over points with a sample, bounded below so that it never reaches rounding errors."""
    squared, observed = squared_residuals(surface, field, K_cell, T_cam_obj)
    length = float(np.sqrt(np.mean(np.square(surface.descriptors).sum(1))))
    median = float(np.sqrt(np.median(squared[observed]))) if observed.any() else length
    return max(median, _MIN_SCALE * length, float(np.finfo(np.float32).tiny))


def l2_normalize(features: Float32[np.ndarray, "*n c"]) -> Float32[np.ndarray, "*n c"]:
    """Vectors scaled to length 1 along the last axis; zero vectors stay zero."""
    length = np.linalg.norm(features, axis=-1, keepdims=True)
    return features / np.where(length > 0, length, 1)


def build_level(
    query: Float32[np.ndarray, "h w c"],
    query_mask: Bool[np.ndarray, "h w"],
    template: Float32[np.ndarray, "y x c"],
    template_mask: Bool[np.ndarray, "y x"],
    cell: Int[np.ndarray, " m"],
    points_obj: Float[np.ndarray, "m 3"],
    *,
    sigma_cells: float,
    normalize: bool,
) -> tuple[Surface, FeatureField]:
    """One level of the coarse-to-fine refinement: the template's surface and the query's field, equally blurred.

    ``cell``: flat indices of the template cells to use; ``points_obj``: their object points, mm.
    """
    F = smooth_foreground(query, query_mask, sigma_cells=sigma_cells)
    d = smooth_foreground(template, template_mask, sigma_cells=sigma_cells).reshape(-1, template.shape[-1])[cell]
    if normalize:
        F, d = l2_normalize(F), l2_normalize(d)
    inside = F[query_mask]
    unobserved = np.square(d).sum(1) + np.square(inside).sum(1).mean() - 2 * d @ inside.mean(0)
    surface = Surface(points_obj, d, np.maximum(unobserved, 0).astype(np.float64))
    return surface, FeatureField.from_map(F, query_mask, normalize=normalize)
