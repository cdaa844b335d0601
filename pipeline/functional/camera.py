"""The pixel convention, written once: pixel centres are integers (BOP, OpenCV), points are (x, y).

Pixel i covers [i - 0.5, i + 0.5]. A map of h x w equal cells over a crop of S pixels has stride s = S / w, and cell
(i, j), row i and column j, is centred at crop pixel ((j + .5) s - .5, (i + .5) s - .5).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from torch import Tensor


def project(K: Float[np.ndarray, "3 3"], points_cam: Float[np.ndarray, "*m 3"]) -> Float[np.ndarray, "*m 2"]:
    """Pixels (x, y) of points in the camera frame. The caller sees to z > 0."""
    p = points_cam @ K.T
    return p[..., :2] / p[..., 2:]


def unproject(
    K: Float[np.ndarray, "3 3"], px: Float[np.ndarray, "*m 2"], depth_mm: Float[np.ndarray, "*m"]
) -> Float[np.ndarray, "*m 3"]:
    """Points in the camera frame (mm) at a depth along the optical axis."""
    rays = np.concatenate([px, np.ones_like(px[..., :1])], -1) @ np.linalg.inv(K).T
    return rays * depth_mm[..., None]


def apply(A: Float[np.ndarray, "3 3"], px: Float[np.ndarray, "*m 2"]) -> Float[np.ndarray, "*m 2"]:
    """Pixels moved by an affine map between planes, e.g. A_crop_img."""
    return px @ A[:2, :2].T + A[:2, 2]


def resize_affine(factor: float) -> Float[np.ndarray, "3 3"]:
    """A_large_small of an image enlarged by ``factor``: pixel edges stay on pixel edges."""
    shift = (factor - 1) / 2
    return np.array([[factor, 0.0, shift], [0.0, factor, shift], [0.0, 0.0, 1.0]])


def square_crop(
    bbox_xyxy: tuple[float, float, float, float], *, size: int, padding_ratio: float
) -> Float[np.ndarray, "3 3"]:
    """A_crop_img of the square around a box's centre whose side is ``padding_ratio`` times its longer side."""
    x0, y0, x1, y1 = bbox_xyxy
    side = max(x1 - x0, y1 - y0) * padding_ratio
    scale = size / side
    left, top = (x0 + x1 - side) / 2, (y0 + y1 - side) / 2
    # crop edge -0.5 lies on image edge ``left``
    return np.array([[scale, 0.0, -left * scale - 0.5], [0.0, scale, -top * scale - 0.5], [0.0, 0.0, 1.0]])


def mask_bbox(mask: Bool[np.ndarray, "H W"]) -> tuple[float, float, float, float] | None:
    """Edges (x0, y0, x1, y1) of a mask's pixels, None for an empty mask."""
    ys, xs = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(ys):
        return None
    return float(xs[0]) - 0.5, float(ys[0]) - 0.5, float(xs[-1]) + 0.5, float(ys[-1]) + 0.5


def cell_affine(*, size: int, cells: int) -> Float[np.ndarray, "3 3"]:
    """A_cell_crop: crop pixels to positions (column, row) on a map of ``cells`` cells a side; undoes cell_to_px."""
    return resize_affine(cells / size)


def cell_to_px(cell_xy: Float[Tensor, "m 2"], *, size: int, cells: int) -> Float[Tensor, "m 2"]:
    """Crop pixels (x, y) of positions (column, row) on a map of ``cells`` cells a side; fractions are kept."""
    stride = size / cells
    return (cell_xy + 0.5) * stride - 0.5


def grid_xy(cell: Int[Tensor, " m"], *, width: int) -> Int[Tensor, "m 2"]:
    """(column, row) of flat cell indices of a map ``width`` cells wide."""
    import torch

    return torch.stack([cell % width, cell // width], dim=-1)
