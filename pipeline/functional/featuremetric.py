"""A pose from feature maps without matching: object points whose descriptors the query ought to show where they land.

A query's map is read in between cells, bilinear, at positions (x, y) in cells. Points that land outside the map,
outside its mask or behind the camera read nothing. Residuals need inner products alone, and those of a map with itself
are the same in every step, so that a step costs one product of each point's descriptor with the four cells around it.

An increment xi = (v, omega) turns about the points' centre c in the camera frame: p -> c + exp(omega) (p - c) + v, a
left multiplication of T_cam_obj that does not mix turning with shifting.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from pipeline.functional.rigid import nearest_rotation, rigid, transform

_FILL_CELLS = 0.7  # blur that carries the foreground's descriptors over its edge
_DAMPING = (1e-7, 1e-3, 1e6)  # least, first, and where no step is left
_FALL = 1e-4  # relative fall of the cost that is not worth another step
_FLOOR = 0.05  # least scale, in lengths of a descriptor: residuals of an exact fit are rounding
_CORNERS = ((0, 0), (0, 1), (1, 0), (1, 1))  # row, column


@dataclass(frozen=True, eq=False)
class FeatureField:
    """A query's descriptors by squares of four neighbouring cells' centres, in reading order of the upper left one.

    ``gram``: inner products of the four. ``directions``: a descriptor read counts as if it were of unit length.
    """

    corners: Float32[np.ndarray, "n 4 c"]
    gram: Float32[np.ndarray, "n 4 4"]
    mask: Bool[np.ndarray, "h w"]
    directions: bool

    @classmethod
    def from_map(
        cls, values: Float32[np.ndarray, "h w c"], mask: Bool[np.ndarray, "h w"], *, directions: bool = False
    ) -> FeatureField:
        """The field of a map."""
        h, w, c = values.shape
        four = [values[i : h - 1 + i, j : w - 1 + j] for i, j in _CORNERS]
        corners = np.stack(four, axis=2).reshape(-1, 4, c)
        return cls(corners, np.matmul(corners, corners.swapaxes(1, 2)), mask, directions)


@dataclass(frozen=True, eq=False)
class Surface:
    """Object points (mm), the descriptor of each, and its mean squared residual to the query's foreground cells."""

    points_obj: Float[np.ndarray, "m 3"]
    descriptors: Float32[np.ndarray, "m c"]
    unseen: Float[np.ndarray, " m"]


@dataclass(frozen=True, eq=False)
class Residuals:
    """Of points that read a field: squared residuals, half their gradient by (x, y) and Gauss-Newton's half Hessian."""

    squared: Float[np.ndarray, " m"]
    pull: Float[np.ndarray, "m 2"]
    curve: Float[np.ndarray, "m 2 2"]


@dataclass(frozen=True, eq=False)
class RobustLoss:
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


def smooth_foreground(
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


def residuals_at(
    field: FeatureField, xy: Float[np.ndarray, "m 2"], descriptors: Float32[np.ndarray, "m c"]
) -> Residuals:
    """What is read at positions inside the map, minus the descriptors that ought to be there. Per cell."""
    h, w = field.mask.shape
    corner = np.clip(np.floor(xy).astype(np.int64), 0, (w - 2, h - 2))
    a, b = (xy - corner).T
    square = corner[:, 1] * (w - 1) + corner[:, 0]
    value = [(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b]
    by_x, by_y = [b - 1, 1 - b, -b, b], [a - 1, -a, 1 - a, a]
    weights = np.stack([np.stack(rows, axis=1) for rows in (value, by_x, by_y)], axis=1)
    own = np.matmul(np.matmul(weights, field.gram[square]), weights.swapaxes(1, 2))
    with_descriptor = np.matmul(field.corners[square], descriptors[:, :, None]).astype(np.float64)
    cross = np.matmul(weights, with_descriptor)[:, :, 0]
    power = np.square(descriptors, dtype=np.float64).sum(1)
    if field.directions:
        own, cross = _of_directions(own, cross)
    squared = np.maximum(own[:, 0, 0] + power - 2 * cross[:, 0], 0)
    return Residuals(squared, own[:, 0, 1:] - cross[:, 1:], own[:, 1:, 1:])


def _of_directions(
    own: Float[np.ndarray, "m 3 3"], cross: Float[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, "m 3 3"], Float[np.ndarray, "m 3"]]:
    """Inner products of f / |f| and its derivatives, from those of f and its own: the part along f drops out."""
    power = np.maximum(own[:, 0, 0], np.finfo(np.float32).tiny)
    length, along = np.sqrt(power), own[:, 0, 1:] / power[:, None]
    turned = np.zeros_like(own)
    turned[:, 0, 0] = 1
    turned[:, 1:, 1:] = own[:, 1:, 1:] / power[:, None, None] - along[:, :, None] * along[:, None]
    seen = cross / length[:, None]
    seen[:, 1:] -= seen[:, :1] * along
    return turned, seen


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


def apply_increment(
    T_cam_obj: Float[np.ndarray, "4 4"], centre_cam: Float[np.ndarray, " 3"], xi: Float[np.ndarray, " 6"]
) -> Float[np.ndarray, "4 4"]:
    """The pose after an increment about a point of the camera frame."""
    turn = cv2.Rodrigues(xi[3:])[0]
    R = nearest_rotation(turn @ T_cam_obj[:3, :3])
    return rigid(R, turn @ (T_cam_obj[:3, 3] - centre_cam) + centre_cam + xi[:3])


def squared_residuals(
    surface: Surface, field: FeatureField, K_cell: Float[np.ndarray, "3 3"], T_cam_obj: Float[np.ndarray, "4 4"]
) -> tuple[Float[np.ndarray, " m"], Bool[np.ndarray, " m"]]:
    """Squared residual of every point, and which points read the query: the others have their ``unseen``."""
    xy, _ = project_cells(K_cell, transform(T_cam_obj, surface.points_obj), np.zeros(3))
    seen = in_foreground(field, xy)
    squared = surface.unseen.copy()
    squared[seen] = residuals_at(field, xy[seen], surface.descriptors[seen]).squared
    return squared, seen


def in_foreground(field: FeatureField, xy: Float[np.ndarray, "m 2"]) -> Bool[np.ndarray, " m"]:
    """Which positions lie in a foreground cell, between centres of cells."""
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
    """Mean robust cost over all points, Gauss-Newton's matrix and gradient of it, and the increment's centre.

    A point that reads nothing costs what its residual to a mean cell of the query costs, so that no pose gains by
    moving points out of sight.
    """
    points_cam = transform(T_cam_obj, surface.points_obj)
    centre = points_cam.mean(0)
    xy, by_xi = project_cells(K_cell, points_cam, centre)
    seen = in_foreground(field, xy)
    found = residuals_at(field, xy[seen], surface.descriptors[seen])
    squared = surface.unseen.copy()
    squared[seen] = found.squared
    weight = robust.weight(found.squared) / len(squared)
    by_xi = by_xi[seen]
    pull = (found.pull * weight[:, None]).reshape(-1)
    curve = np.matmul(found.curve * weight[:, None, None], by_xi).reshape(-1, 6)
    J = by_xi.reshape(-1, 6)
    return float(robust.cost(squared).mean()), J.T @ curve, J.T @ pull, centre


def descend(
    surface: Surface,
    field: FeatureField,
    K_cell: Float[np.ndarray, "3 3"],
    T_cam_obj: Float[np.ndarray, "4 4"],
    robust: RobustLoss,
    *,
    iterations: int,
) -> Float[np.ndarray, "4 4"]:
    """The pose after at most that many steps of Levenberg-Marquardt; each step taken lowers the mean robust cost.

    Marquardt's damping: the matrix's own diagonal, ten times more of it after a step that did not help, ten times less
    after one that did. Ends where the next step promises no fall that is worth it.
    """
    least, damping, most = _DAMPING
    cost, H, g, centre = normal_equations(surface, field, K_cell, T_cam_obj, robust)
    for _ in range(iterations):
        diagonal = np.diag(H)
        if damping > most or not diagonal.min() > 0:
            break
        step = np.linalg.solve(H + damping * np.diag(diagonal), -g)
        if -(g + H @ step / 2) @ step < _FALL * cost:
            break
        T_next = apply_increment(T_cam_obj, centre, step)
        after = normal_equations(surface, field, K_cell, T_next, robust)
        if after[0] < cost:
            T_cam_obj, (cost, H, g, centre), damping = T_next, after, max(damping / 10, least)
        else:
            damping *= 10
    return T_cam_obj


def robust_scale(
    surface: Surface, field: FeatureField, K_cell: Float[np.ndarray, "3 3"], T_cam_obj: Float[np.ndarray, "4 4"]
) -> float:
    """Median length of the residuals of the points that read the query; never below rounding of an exact fit."""
    squared, seen = squared_residuals(surface, field, K_cell, T_cam_obj)
    length = float(np.sqrt(np.mean(np.square(surface.descriptors).sum(1))))
    median = float(np.sqrt(np.median(squared[seen]))) if seen.any() else length
    return max(median, _FLOOR * length, float(np.finfo(np.float32).tiny))


def l2_normalize(features: Float32[np.ndarray, "*n c"]) -> Float32[np.ndarray, "*n c"]:
    """Descriptors of unit length; 0 stays 0."""
    length = np.linalg.norm(features, axis=-1, keepdims=True)
    return features / np.where(length > 0, length, 1)


def build_level(
    query: Float32[np.ndarray, "h w c"],
    query_mask: Bool[np.ndarray, "h w"],
    template: Float32[np.ndarray, "h w c"],
    template_mask: Bool[np.ndarray, "h w"],
    cell: Int[np.ndarray, " m"],
    points_obj: Float[np.ndarray, "m 3"],
    *,
    sigma_cells: float,
    directions: bool,
) -> tuple[Surface, FeatureField]:
    """Template cells (flat indices) with their points, and the query, both smoothed alike."""
    shown = smooth_foreground(query, query_mask, sigma_cells=sigma_cells)
    d = smooth_foreground(template, template_mask, sigma_cells=sigma_cells).reshape(-1, template.shape[-1])[cell]
    if directions:
        shown, d = l2_normalize(shown), l2_normalize(d)
    inside = shown[query_mask]
    unseen = np.square(d).sum(1) + np.square(inside).sum(1).mean() - 2 * d @ inside.mean(0)
    surface = Surface(points_obj, d, np.maximum(unseen, 0).astype(np.float64))
    return surface, FeatureField.from_map(shown, query_mask, directions=directions)
