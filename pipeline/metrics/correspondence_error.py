"""correspondences, true pose -> distance of each template point from the ray of its query pixel."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipeline.functional.camera import project
from pipeline.functional.rigid import transform


def correspondence_errors_mm(
    points_obj: Float[np.ndarray, "m 3"],
    px_img: Float[np.ndarray, "m 2"],
    K: Float[np.ndarray, "3 3"],
    T_gt: Float[np.ndarray, "4 4"],
    symmetries: Float[np.ndarray, "s 4 4"],
) -> Float[np.ndarray, " finite"]:
    """Distance of each object point from the ray of its query pixel, measured parallel to the image plane, mm.

    Uses the symmetry with the smallest median; rows with NaN are dropped. Depth along the ray is not compared, so a
    point on the far side of the object may get a small error.
    """
    finite = np.isfinite(points_obj).all(1) & np.isfinite(px_img).all(1)
    points, px = points_obj[finite], px_img[finite]
    candidates = [_ray_distances_mm(points, px, K, T_gt @ symmetry) for symmetry in symmetries]
    return min(candidates, key=lambda errors: float(np.median(errors)) if len(errors) else 0.0)


def _ray_distances_mm(
    points: Float[np.ndarray, "m 3"],
    px: Float[np.ndarray, "m 2"],
    K: Float[np.ndarray, "3 3"],
    T_cam_obj: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, " m"]:
    points_cam = transform(T_cam_obj, points)
    offset = (project(K, points_cam) - px) / [K[0, 0], K[1, 1]]
    return np.linalg.norm(offset, axis=-1) * points_cam[:, 2]
