"""template points, depth -> object points."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipeline.functional.camera import apply_homography, unproject
from pipeline.functional.rigid import inverse, transform


def lift(
    px_crop: Float[np.ndarray, "m 2"],
    A_crop_img: Float[np.ndarray, "3 3"],
    depth_mm: Float[np.ndarray, "H W"],
    K: Float[np.ndarray, "3 3"],
    T_cam_obj: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, "m 3"]:
    """Object points (mm) at a template's crop pixels (x, y).

    Each lies on the ray through its exact position, at the depth of the nearest pixel; NaN where that depth is 0.
    Raises ValueError for a point outside the depth map.
    """
    px = apply_homography(np.linalg.inv(A_crop_img), np.asarray(px_crop, dtype=np.float64))
    column, row = np.floor(px + 0.5).astype(np.int64).T
    height, width = depth_mm.shape
    outside = (column < 0) | (column >= width) | (row < 0) | (row >= height)
    if outside.any():
        x, y = px[outside][0]
        raise ValueError(f"template point ({x:.1f}, {y:.1f}) lies outside the {width} x {height} px depth map")
    depth = depth_mm[row, column].astype(np.float64)
    points_cam = unproject(K, px, np.where(depth > 0, depth, np.nan))
    return transform(inverse(T_cam_obj), points_cam)
