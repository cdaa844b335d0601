"""correspondences, true pose -> how far from its query pixel each template point truly lies."""

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
    """Distance (mm) of each object point from the ray of its query pixel, parallel to the image plane.

    Under the symmetry for which the median is least; rows with NaN are left out. Depth along the ray is not compared: a
    point on the far side of the object may come out near.
    """
    finite = np.isfinite(points_obj).all(1) & np.isfinite(px_img).all(1)
    points, px = points_obj[finite], px_img[finite]
    found = [_errors_mm(points, px, K, T_gt @ symmetry) for symmetry in symmetries]
    return min(found, key=lambda errors: float(np.median(errors)) if len(errors) else 0.0)


def _errors_mm(
    points: Float[np.ndarray, "m 3"],
    px: Float[np.ndarray, "m 2"],
    K: Float[np.ndarray, "3 3"],
    T_cam_obj: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, " m"]:
    in_camera = transform(T_cam_obj, points)
    off = (project(K, in_camera) - px) / [K[0, 0], K[1, 1]]
    return np.linalg.norm(off, axis=-1) * in_camera[:, 2]
