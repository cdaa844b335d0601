"""pose, measured depth -> the pose, moved along the viewing ray and aligned with the measured surface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from pipeline.functional.rigid import inverse, rigid, transform

FEWEST_POINTS = 60
MOST_TRAVEL = 0.15
"""Of the diameter: an alignment that moves a point this far has latched onto another surface, and is discarded."""
_POINTS = 2000
_MOST_SLOPED = 0.3  # least cosine between normal and viewing ray; depth is unreliable at grazing angles

Pose = Float[np.ndarray, "4 4"]
DepthImage = Float[np.ndarray, "H W"]


@dataclass(frozen=True, eq=False)
class MeasuredSurface:
    """Points and normals of a depth image in the camera frame, mm; ``valid``: pixels of the mask with both."""

    points: Float[np.ndarray, "H W 3"]
    normals: Float[np.ndarray, "H W 3"]
    valid: Bool[np.ndarray, "H W"]


def fit_depth(
    T_cam_obj: Pose,
    render: Callable[[Pose], DepthImage],
    depth_mm: DepthImage,
    mask: Bool[np.ndarray, "H W"],
    K: Float[np.ndarray, "3 3"],
    diameter_mm: float,
    *,
    rounds: int,
) -> Pose:
    """The pose fitted to measured depth (mm, 0 where unknown) inside ``mask``; unchanged if too little is measured.

    First moves the pose along the viewing ray by the median difference between measured and rendered depth. Then
    ``rounds`` of point-to-plane ICP (Chen and Medioni, 1992) align the visible surface with the measured one.
    """
    moved = _follow_ray(T_cam_obj, render, depth_mm, mask, K)
    drawn = render(moved)
    shown = (drawn > 0) & mask
    if shown.sum() < FEWEST_POINTS or ((depth_mm > 0) & shown).sum() < FEWEST_POINTS:
        return moved
    surface = _measure_surface(depth_mm, mask, K)
    ys, xs = np.nonzero(shown)
    chosen = np.linspace(0, len(ys) - 1, min(_POINTS, len(ys))).astype(int)
    points_obj = transform(inverse(moved), _backproject(drawn, K)[ys[chosen], xs[chosen]])
    aligned, gate = moved, 0.1 * diameter_mm
    for _ in range(rounds):
        step = _align_once(aligned, points_obj, surface, K, gate)
        if step is None:
            return moved
        aligned, spread = step
        gate = float(np.clip(4 * spread, 3.0, 0.1 * diameter_mm))
    travelled = np.linalg.norm(transform(aligned, points_obj) - transform(moved, points_obj), axis=1).max()
    return aligned if travelled < MOST_TRAVEL * diameter_mm else moved


def _follow_ray(
    T_cam_obj: Pose,
    render: Callable[[Pose], DepthImage],
    depth_mm: DepthImage,
    mask: Bool[np.ndarray, "H W"],
    K: Float[np.ndarray, "3 3"],
) -> Pose:
    for _ in range(2):
        drawn = render(T_cam_obj)
        both = (drawn > 0) & (depth_mm > 0) & mask
        if both.sum() < FEWEST_POINTS:
            break
        centre = _backproject(drawn, K)[both].mean(axis=0)
        T_cam_obj = T_cam_obj.copy()
        T_cam_obj[:3, 3] += float(np.median(depth_mm[both] - drawn[both])) * centre / centre[2]
    return T_cam_obj


def _backproject(depth_mm: DepthImage, K: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "H W 3"]:
    """Points of all pixels in the camera frame, mm."""
    y, x = np.mgrid[: depth_mm.shape[0], : depth_mm.shape[1]]
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(K).T
    return np.asarray(rays * depth_mm[..., None].astype(float))


def _measure_surface(
    depth_mm: DepthImage, mask: Bool[np.ndarray, "H W"], K: Float[np.ndarray, "3 3"]
) -> MeasuredSurface:
    """Points and normals of the measured depth; normals are finite differences of the smoothed depth."""
    points = _backproject(depth_mm, K)
    smooth = _backproject(cv2.bilateralFilter(depth_mm.astype(np.float32), 7, 15.0, 3.0), K)
    across = np.roll(smooth, -2, axis=1) - np.roll(smooth, 2, axis=1)
    down = np.roll(smooth, -2, axis=0) - np.roll(smooth, 2, axis=0)
    normals = np.cross(down, across)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    normals = normals / np.maximum(length, 1e-9)
    facing = -(normals * points).sum(axis=-1) / np.maximum(np.linalg.norm(points, axis=-1), 1e-9)
    inner = cv2.erode((mask & (depth_mm > 0)).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return MeasuredSurface(points, normals, inner & (facing > _MOST_SLOPED))


def _align_once(
    T_cam_obj: Pose,
    points_obj: Float[np.ndarray, "n 3"],
    surface: MeasuredSurface,
    K: Float[np.ndarray, "3 3"],
    gate: float,
) -> tuple[Pose, float] | None:
    """The pose after one point-to-plane step, and the spread of the residuals, mm.

    Each point is paired with the measured point at its pixel. None if too few pairs are within ``gate`` (mm).
    """
    points = transform(T_cam_obj, points_obj)
    px = points @ K.T
    x, y = np.rint(px[:, :2] / px[:, 2:]).astype(int).T
    h, w = surface.valid.shape
    inside = (x >= 0) & (y >= 0) & (x < w) & (y < h) & (points[:, 2] > 0)
    points, x, y = points[inside], x[inside], y[inside]
    offset, normals = surface.points[y, x] - points, surface.normals[y, x]
    residual = (offset * normals).sum(axis=1)
    near = surface.valid[y, x] & (np.abs(residual) < gate) & (np.linalg.norm(offset, axis=1) < 3 * gate)
    if near.sum() < FEWEST_POINTS:
        return None
    points, residual, normals = points[near], residual[near], normals[near]
    spread = 1.48 * float(np.median(np.abs(residual)))
    weight = 1 / np.maximum(1, np.abs(residual) / max(spread, 0.5))
    centre = points.mean(axis=0)
    jacobian = np.concatenate([np.cross(points - centre, normals), normals], axis=1)
    normal_matrix = jacobian.T @ (weight[:, None] * jacobian)
    # light damping keeps unconstrained motions, such as a can's rotation about its axis, at zero
    damping = 1e-3 * np.diag(np.diag(normal_matrix)) + 1e-9 * np.eye(6)
    step = np.linalg.solve(normal_matrix + damping, jacobian.T @ (weight * residual))
    R = Rotation.from_rotvec(step[:3]).as_matrix()
    return rigid(R, centre - R @ centre + step[3:]) @ T_cam_obj, spread
