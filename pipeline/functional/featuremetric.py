"""A pose from feature maps without matching: object points whose descriptors the query ought to show where they land.

A query's map is read in between cells, at positions (x, y) in cells. Points that land outside the map, outside its
mask or behind the camera read nothing. An increment xi = (v, omega) turns about the points' centre c in the camera
frame: p -> c + exp(omega) (p - c) + v, a left multiplication of T_cam_obj that does not mix turning with shifting.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from pipeline.functional.rigid import nearest_rotation, rigid, transform

_FILL_CELLS = 0.7  # blur that carries the foreground's descriptors over its edge
_DAMPING = (1e-7, 1e-3, 1e6)  # least, first, and where no step is left
_FALL = 1e-6  # relative fall of the cost that is not worth another step
_FLOOR = 0.05  # least scale, in lengths of a descriptor: residuals of an exact fit are rounding


@dataclass(frozen=True, eq=False)
class Field:
    """A query's descriptors at cell centres and, behind its mask's edge, what the nearest foreground shows."""

    values: Float32[np.ndarray, "h w c"]
    mask: Bool[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class Surface:
    """Object points (mm), the descriptor of each, and the squared residual it has to a mean cell of the query."""

    points_obj: Float[np.ndarray, "m 3"]
    descriptors: Float32[np.ndarray, "m c"]
    unseen: Float32[np.ndarray, " m"]


@dataclass(frozen=True, eq=False)
class Robust:
    """The loss of Barron, CVPR 2019, Eq. 9, of a squared residual over ``scale`` squared; ``alpha`` below 2.

    0: Cauchy; -2: Geman-McClure. Smaller: sooner indifferent to how far off an outlier is.
    """

    alpha: float
    scale: float

    def cost(self, squared: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """Loss of each residual; 0 for none, and half of squared / scale^2 for small ones."""
        x, bend = squared / self.scale**2, 2.0 - self.alpha
        if self.alpha == 0:
            return np.log1p(x / 2)
        return bend / self.alpha * ((x / bend + 1) ** (self.alpha / 2) - 1)

    def weight(self, squared: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """Twice the derivative of the loss by ``squared``: what reweighted least squares multiply residuals with."""
        x, bend = squared / self.scale**2, 2.0 - self.alpha
        return (x / bend + 1) ** (self.alpha / 2 - 1) / self.scale**2


def smoothed(
    features: Float32[np.ndarray, "h w c"], mask: Bool[np.ndarray, "h w"], *, sigma_cells: float
) -> Float32[np.ndarray, "h w c"]:
    """Gaussian mean over the foreground alone, at foreground cells and behind their edge; 0 far from any.

    ``sigma_cells`` 0: the foreground as it is.
    """
    sigma = sigma_cells or _FILL_CELLS
    rows, columns = (_gaussian(n, sigma) for n in mask.shape)
    weight = rows @ mask.astype(np.float32) @ columns
    total = np.tensordot(rows, features * mask[..., None], axes=1)
    total = np.matmul(columns, total)
    mean = total / np.maximum(weight, 1e-6)[..., None]
    return mean if sigma_cells else np.where(mask[..., None], features, mean)


def _gaussian(n: int, sigma: float) -> Float32[np.ndarray, "n n"]:
    apart = np.arange(n)[:, None] - np.arange(n)
    return np.exp(-0.5 * (apart / sigma) ** 2).astype(np.float32)


def read(
    field: Field, xy: Float[np.ndarray, "m 2"]
) -> tuple[Float32[np.ndarray, "m c"], Float32[np.ndarray, "m c"], Float32[np.ndarray, "m c"]]:
    """Descriptors at positions inside the map, bilinear, and their derivatives by x and by y, per cell."""
    h, w, _ = field.values.shape
    corner = np.clip(np.floor(xy).astype(np.int64), 0, (w - 2, h - 2))
    a, b = np.split((xy - corner).astype(np.float32), 2, axis=1)
    flat, index = field.values.reshape(h * w, -1), corner[:, 1] * w + corner[:, 0]
    here, right, below, across = (flat[index + step] for step in (0, 1, w, w + 1))
    top, bottom = right - here, across - below
    upper, lower = here + a * top, below + a * bottom
    dy = lower - upper
    return upper + b * dy, top + b * (bottom - top), dy


def project_cells(
    K_cell: Float[np.ndarray, "3 3"], points_cam: Float[np.ndarray, "m 3"], centre_cam: Float[np.ndarray, " 3"]
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2 6"]]:
    """Positions in cells, and their derivatives by the increment; NaN for points that are not in front.

    ``K_cell`` takes camera to cells: any 3 x 3 matrix, the camera's own times an affine map or a homography of planes.
    """
    front = (points_cam[:, 2] > 0) & (points_cam @ K_cell[2] > 0)
    p = np.where(front[:, None], points_cam, np.nan)
    q = p @ K_cell.T
    xy = q[:, :2] / q[:, 2:]
    by_point = (K_cell[:2] - xy[:, :, None] * K_cell[2]) / q[:, 2:, None]
    arm = (p - centre_cam)[:, None]
    return xy, np.concatenate([by_point, np.cross(arm, by_point)], axis=2)  # row . (omega x arm) = omega . (arm x row)


def moved(
    T_cam_obj: Float[np.ndarray, "4 4"], centre_cam: Float[np.ndarray, " 3"], xi: Float[np.ndarray, " 6"]
) -> Float[np.ndarray, "4 4"]:
    """The pose after an increment about a point of the camera frame."""
    turn = cv2.Rodrigues(xi[3:])[0]
    R = nearest_rotation(turn @ T_cam_obj[:3, :3])
    return rigid(R, turn @ (T_cam_obj[:3, 3] - centre_cam) + centre_cam + xi[:3])


def residuals(
    surface: Surface, field: Field, K_cell: Float[np.ndarray, "3 3"], T_cam_obj: Float[np.ndarray, "4 4"]
) -> tuple[Float[np.ndarray, " m"], Bool[np.ndarray, " m"]]:
    """Squared residual of every point, and which points read the query: the others have their ``unseen``."""
    points_cam = transform(T_cam_obj, surface.points_obj)
    xy, _ = project_cells(K_cell, points_cam, points_cam.mean(0))
    seen = _lands(field, xy)
    squared = surface.unseen.astype(np.float64)
    apart = read(field, xy[seen])[0] - surface.descriptors[seen]
    squared[seen] = np.einsum("mc,mc->m", apart, apart)
    return squared, seen


def _lands(field: Field, xy: Float[np.ndarray, "m 2"]) -> Bool[np.ndarray, " m"]:
    """Which positions lie in a foreground cell, between centres of cells."""
    h, w = field.mask.shape
    with np.errstate(invalid="ignore"):
        inside = np.asarray(((xy >= 0) & (xy <= (w - 1, h - 1))).all(1))
    column, row = np.where(inside[:, None], np.floor(xy + 0.5), 0).astype(np.int64).T
    return inside & field.mask[row, column]


def normal_equations(
    surface: Surface,
    field: Field,
    K_cell: Float[np.ndarray, "3 3"],
    T_cam_obj: Float[np.ndarray, "4 4"],
    robust: Robust,
) -> tuple[float, Float[np.ndarray, "6 6"], Float[np.ndarray, " 6"], Float[np.ndarray, " 3"]]:
    """Mean robust cost over all points, Gauss-Newton's matrix and gradient of it, and the increment's centre.

    A point that reads nothing costs what its residual to a mean cell of the query costs, so that no pose gains by
    moving points out of sight.
    """
    points_cam = transform(T_cam_obj, surface.points_obj)
    centre = points_cam.mean(0)
    xy, by_xi = project_cells(K_cell, points_cam, centre)
    seen = _lands(field, xy)
    values, dx, dy = read(field, xy[seen])
    apart = values - surface.descriptors[seen]
    squared = surface.unseen.astype(np.float64)
    squared[seen] = np.einsum("mc,mc->m", apart, apart)
    weight = robust.weight(squared[seen]) / len(squared)
    xx, x_y, yy, xr, yr = (
        np.einsum("mc,mc->m", a, b) for a, b in ((dx, dx), (dx, dy), (dy, dy), (dx, apart), (dy, apart))
    )
    gram = np.stack([xx, x_y, x_y, yy], 1).reshape(-1, 2, 2) * weight[:, None, None]
    pull = np.stack([xr, yr], 1) * weight[:, None]
    J = by_xi[seen].reshape(-1, 6)
    weighted = np.matmul(gram, by_xi[seen]).reshape(-1, 6)
    return float(robust.cost(squared).mean()), J.T @ weighted, J.T @ pull.reshape(-1), centre


def descend(
    surface: Surface,
    field: Field,
    K_cell: Float[np.ndarray, "3 3"],
    T_cam_obj: Float[np.ndarray, "4 4"],
    robust: Robust,
    *,
    iterations: int,
) -> Float[np.ndarray, "4 4"]:
    """The pose after at most that many steps of Levenberg-Marquardt; each step taken lowers the mean robust cost.

    Marquardt's damping: the matrix's own diagonal, ten times more of it after a step that did not help, ten times less
    after one that did.
    """
    least, damping, most = _DAMPING
    cost, H, g, centre = normal_equations(surface, field, K_cell, T_cam_obj, robust)
    for _ in range(iterations):
        diagonal = np.diag(H)
        if damping > most or not diagonal.min() > 0:
            break
        step = np.linalg.solve(H + damping * np.diag(diagonal), -g)
        T_next = moved(T_cam_obj, centre, step)
        after = normal_equations(surface, field, K_cell, T_next, robust)
        if not after[0] < cost:
            damping *= 10
            continue
        fall = 1 - after[0] / cost
        T_cam_obj, (cost, H, g, centre), damping = T_next, after, max(damping / 10, least)
        if fall < _FALL:
            break
    return T_cam_obj


def robust_scale(
    surface: Surface, field: Field, K_cell: Float[np.ndarray, "3 3"], T_cam_obj: Float[np.ndarray, "4 4"]
) -> float:
    """Median length of the residuals of the points that read the query; never below rounding of an exact fit."""
    squared, seen = residuals(surface, field, K_cell, T_cam_obj)
    length = float(np.sqrt(np.mean(np.square(surface.descriptors).sum(1))))
    median = float(np.sqrt(np.median(squared[seen]))) if seen.any() else length
    return max(median, _FLOOR * length, float(np.finfo(np.float32).tiny))


def unit(features: Float32[np.ndarray, "*n c"]) -> Float32[np.ndarray, "*n c"]:
    """Descriptors of unit length; 0 stays 0."""
    length = np.linalg.norm(features, axis=-1, keepdims=True)
    return features / np.where(length > 0, length, 1)


def level(
    query: Float32[np.ndarray, "h w c"],
    query_mask: Bool[np.ndarray, "h w"],
    template: Float32[np.ndarray, "h w c"],
    template_mask: Bool[np.ndarray, "h w"],
    cell: Sequence[int] | np.ndarray,
    points_obj: Float[np.ndarray, "m 3"],
    *,
    sigma_cells: float,
) -> tuple[Surface, Field]:
    """Template cells (flat indices) with their points, and the query, both smoothed alike."""
    field = Field(smoothed(query, query_mask, sigma_cells=sigma_cells), query_mask)
    d = smoothed(template, template_mask, sigma_cells=sigma_cells).reshape(-1, template.shape[-1])[cell]
    shown = field.values[query_mask]
    mean, power = shown.mean(0), float(np.square(shown).sum(1).mean())
    unseen = np.maximum(np.square(d).sum(1) + power - 2 * d @ mean, 0)
    return Surface(points_obj, d, unseen), field
