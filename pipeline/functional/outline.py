"""Fit a pose to matched points and to the outline of a mask, in the crop."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float

from pipeline.functional.featuremetric import apply_increment, project_cells
from pipeline.functional.rigid import transform

MATCH_SCALE_PX = 2.0  # of the Cauchy weights of matches, crop pixels
OUTLINE_SCALE_PX = 2.0  # of the Geman-McClure weights of the outline, crop pixels
FAR_PX = 6.0  # residuals of this size and more do not count: there, an occluder or another object forms the border
ITERATIONS = 15
DAMPING = 1e-3


def signed_distance_px(mask: Bool[np.ndarray, "S S"]) -> Float[np.ndarray, "S S"]:
    """Distance of every pixel's centre to the border of the mask, px; negative inside."""
    inside = np.ascontiguousarray(mask, dtype=np.uint8)
    far, near = (cv2.distanceTransform(m, cv2.DIST_L2, cv2.DIST_MASK_5) for m in (1 - inside, inside))
    return np.where(mask, 0.5 - near, far - 0.5).astype(float)


def outline_px(mask: Bool[np.ndarray, "S S"]) -> Float[np.ndarray, "m 2"]:
    """Pixels (x, y) of the mask that touch its border; their centres lie half a pixel inside it.

    Pixels at the edge of the crop are left out: the object may go on there.
    """
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    border = mask & (cv2.erode(np.ascontiguousarray(mask, dtype=np.uint8), cross) == 0)
    border[[0, -1]] = border[:, [0, -1]] = False
    return np.argwhere(border)[:, ::-1].astype(float)


def fit_outline(
    T_cam_obj: Float[np.ndarray, "4 4"],
    K_crop: Float[np.ndarray, "3 3"],
    matched: tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 2"]],
    outline_obj: Float[np.ndarray, "n 3"],
    distance_px: Float[np.ndarray, "S S"],
    *,
    weight: float,
) -> Float[np.ndarray, "4 4"]:
    """T_cam_obj that brings matched points to their pixels and the outline to the border of the mask.

    Minimises the mean squared distance of the ``matched`` object points (mm) to their crop pixels, plus ``weight``
    times that of ``outline_obj`` (mm), points half a pixel inside the object's outline, to the border of the mask
    (``distance_px``, of signed_distance_px). Detectors' masks are too wide or too narrow, so the border is moved by a
    number of pixels that is estimated too: the outline says where the object is and how it is turned, the matches how
    large it is. Both are iteratively reweighted, so that outliers count little: matches by a Cauchy loss, the outline
    by Geman-McClure. The given pose if there are fewer than 6 points of either.
    """
    points_obj, px = matched
    if min(len(points_obj), len(outline_obj)) < 6:
        return T_cam_obj
    T, wider_px = T_cam_obj, 0.0
    for _ in range(ITERATIONS):
        centre = transform(T, outline_obj).mean(axis=0)
        H, g = _match_equations(project_cells(K_crop, transform(T, points_obj), centre), px)
        projected = project_cells(K_crop, transform(T, outline_obj), centre)
        H_outline, g_outline = _outline_equations(projected, distance_px, wider_px)
        H, g = H + weight * H_outline, g + weight * g_outline
        if not np.diag(H).min() > 0:
            return T_cam_obj
        step = np.linalg.solve(H + DAMPING * np.diag(np.diag(H)), -g)
        T = apply_increment(T, centre, step[:6])
        wider_px = float(np.clip(wider_px + step[6], -FAR_PX, FAR_PX))
        if np.abs(step[:3]).max() < 1e-5 * np.linalg.norm(centre) and np.abs(step[3:]).max() < 1e-5:
            break
    return T


def _match_equations(
    projected: tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2 6"]], px: Float[np.ndarray, "m 2"]
) -> tuple[Float[np.ndarray, "7 7"], Float[np.ndarray, " 7"]]:
    """Gauss-Newton matrix and gradient by the increment of the pose and the move of the border."""
    xy, by_xi = projected
    residual = xy - px
    squared = np.square(residual).sum(axis=1)
    near = squared < (3 * MATCH_SCALE_PX) ** 2  # also False for points behind the camera, which are NaN
    w = np.repeat(1 / (1 + squared[near] / MATCH_SCALE_PX**2) / len(px), 2)
    J = np.pad(by_xi[near].reshape(-1, 6), ((0, 0), (0, 1)))
    return J.T @ (w[:, None] * J), J.T @ (w * residual[near].reshape(-1))


def _outline_equations(
    projected: tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 6"]],
    distance_px: Float[np.ndarray, "S S"],
    wider_px: float,
) -> tuple[Float[np.ndarray, "7 7"], Float[np.ndarray, " 7"]]:
    """As _match_equations, for points that are to lie half a pixel inside a border moved inwards by ``wider_px``."""
    xy, by_xi = projected
    inside = ((xy >= 0) & (xy <= len(distance_px) - 1)).all(axis=1)
    distance, slope = _sample(distance_px, xy[inside])
    residual = distance + 0.5 + wider_px
    w = (np.abs(residual) < FAR_PX) / np.square(1 + np.square(residual / OUTLINE_SCALE_PX)) / len(xy)
    by_pose = np.matmul(slope[:, None], by_xi[inside])[:, 0]
    J = np.column_stack([by_pose, np.ones(len(residual))])
    return J.T @ (w[:, None] * J), J.T @ (w * residual)


def _sample(
    field: Float[np.ndarray, "S S"], xy: Float[np.ndarray, "m 2"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m 2"]]:
    """Bilinear values, and their derivatives by (x, y)."""
    corner = np.clip(np.floor(xy).astype(np.int64), 0, len(field) - 2)
    (a, b), (x, y) = (xy - corner).T, corner.T
    f00, f10, f01, f11 = field[y, x], field[y, x + 1], field[y + 1, x], field[y + 1, x + 1]
    value = (1 - b) * ((1 - a) * f00 + a * f10) + b * ((1 - a) * f01 + a * f11)
    by_x, by_y = (1 - b) * (f10 - f00) + b * (f11 - f01), (1 - a) * (f01 - f00) + a * (f11 - f10)
    return value, np.stack([by_x, by_y], axis=1)
