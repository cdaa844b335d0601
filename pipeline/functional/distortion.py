"""Lens distortion of OpenCV's pinhole model -> images, masks and boxes without it, under the same K.

Coefficients are k1, k2, p1, p2[, k3[, k4, k5, k6]]: radial k and tangential p, in OpenCV's order.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, Float32, Shaped

UNDISTORTION_VERSION = 1
"""Raise it when the same photograph, K and coefficients give other pixels, masks or boxes."""
COUNTS = (4, 5, 8)  # of coefficients; OpenCV's further ones are of thin prisms and tilted sensors
_BAND_PX = 1 << 22  # pixels undistorted at a time: the maps take eight bytes for each of them
_EDGE_POINTS = 17  # on each edge of a box, whose undistorted edges are curves
_GRID = 33  # points per side at which a distortion is checked
_EXACT_PX = 0.1  # OpenCV inverts the distortion by iteration, which may end elsewhere


def undistort(
    image: Shaped[np.ndarray, "H W *c"],
    K: Float[np.ndarray, "3 3"],
    coefficients: Sequence[float],
    *,
    nearest: bool = False,
) -> Shaped[np.ndarray, "H W *c"]:
    """The image that a camera K without distortion takes; 0 where the lens saw nothing. Bilinear, or ``nearest``."""
    h, w = image.shape[:2]
    values = image.astype(np.uint8) if image.dtype == bool else image
    how, out = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR, np.empty_like(values)
    rows = max(1, _BAND_PX // w)
    for top in range(0, h, rows):
        band = out[top : top + rows]
        x, y = _distorted_px(K, coefficients, _shift_rows(K, top), band.shape[:2])
        band[:] = cv2.remap(values, x, y, how, borderMode=cv2.BORDER_CONSTANT)
    return out.astype(image.dtype)


def undistort_box(
    bbox_xyxy: tuple[float, float, float, float], K: Float[np.ndarray, "3 3"], coefficients: Sequence[float]
) -> tuple[float, float, float, float]:
    """The box around a box of the distorted image, in the undistorted one; edges in pixels.

    Raises ValueError where the distortion has no inverse.
    """
    x0, y0, x1, y1 = bbox_xyxy
    x, y, one = np.linspace(x0, x1, _EDGE_POINTS), np.linspace(y0, y1, _EDGE_POINTS), np.ones(_EDGE_POINTS)
    sides = ((x, y0 * one), (x, y1 * one), (x0 * one, y), (x1 * one, y))
    edges, given = np.concatenate([np.stack(side, -1) for side in sides]), np.asarray(coefficients, float)
    rays = cv2.undistortPoints(edges[:, None], K, given)[:, 0]
    points = np.concatenate([rays, np.ones((len(rays), 1))], axis=-1)
    again = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, given)[0][:, 0]
    if not np.abs(again - edges).max() < _EXACT_PX:
        raise ValueError("the distortion has no inverse at the box")
    px = points @ K[:2].T
    (left, top), (right, bottom) = px.min(axis=0), px.max(axis=0)
    return float(left), float(top), float(right), float(bottom)


def folds(K: Float[np.ndarray, "3 3"], coefficients: Sequence[float], size_hw: tuple[int, int]) -> bool:
    """Whether two pixels of the undistorted image show one of the photograph, as with no lens.

    Coefficients of another camera or in another order do so, mostly in the corners.
    """
    h, w = size_hw
    to_grid = np.diag([(_GRID - 1) / max(w - 1, 1), (_GRID - 1) / max(h - 1, 1), 1.0])
    x, y = _distorted_px(K, coefficients, to_grid @ K, (_GRID, _GRID))
    (xv, xu), (yv, yu) = np.gradient(x.astype(float)), np.gradient(y.astype(float))
    return not bool((xu * yv - xv * yu > 0).all())


def _shift_rows(K: Float[np.ndarray, "3 3"], top: int) -> Float[np.ndarray, "3 3"]:
    """K of the image without its first rows."""
    return np.array([[1.0, 0, 0], [0, 1, -top], [0, 0, 1]]) @ K


def _distorted_px(
    K: Float[np.ndarray, "3 3"],
    coefficients: Sequence[float],
    K_out: Float[np.ndarray, "3 3"],
    size_hw: tuple[int, int],
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Positions (x, y) in the photograph of each pixel of an undistorted image with the camera K_out."""
    given = np.asarray(coefficients, float)
    x, y = cv2.initUndistortRectifyMap(K, given, None, K_out, size_hw[::-1], cv2.CV_32FC1)
    return x, y
