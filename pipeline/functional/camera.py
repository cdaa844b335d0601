"""Camera geometry, and the pixel convention: pixel centres are integers (as in BOP and OpenCV), points are (x, y).

Pixel i covers [i - 0.5, i + 0.5]. A map of h x w equal cells over a crop of S pixels has stride s = S / w; cell (i, j),
row i and column j, is centred at crop pixel ((j + .5) s - .5, (i + .5) s - .5).
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.functional.rigid import rotation_between


def project(K: Float[np.ndarray, "3 3"], points_cam: Float[np.ndarray, "*m 3"]) -> Float[np.ndarray, "*m 2"]:
    """Pixels (x, y) of points in the camera frame. The caller ensures z > 0."""
    p = points_cam @ K.T
    return p[..., :2] / p[..., 2:]


def unproject(
    K: Float[np.ndarray, "3 3"], px: Float[np.ndarray, "*m 2"], depth_mm: Float[np.ndarray, "*m"]
) -> Float[np.ndarray, "*m 3"]:
    """Points in the camera frame (mm) of pixels with their depth along the optical axis."""
    rays = np.concatenate([px, np.ones_like(px[..., :1])], -1) @ np.linalg.inv(K).T
    return rays * depth_mm[..., None]


def apply_homography(A: Float[np.ndarray, "3 3"], px: Float[np.ndarray, "*m 2"]) -> Float[np.ndarray, "*m 2"]:
    """Pixels mapped by a homography, e.g. A_crop_img: image to crop. Exactly affine if A's last row is (0, 0, 1)."""
    return (px @ A[:2, :2].T + A[:2, 2]) / (px @ A[2:, :2].T + A[2:, 2])


def resize_affine(factor: float) -> Float[np.ndarray, "3 3"]:
    """A_large_small of an image enlarged by ``factor``; the image borders coincide (align_corners=False)."""
    shift = (factor - 1) / 2
    return np.array([[factor, 0.0, shift], [0.0, factor, shift], [0.0, 0.0, 1.0]])


def square_crop(
    bbox_xyxy: tuple[float, float, float, float], *, size: int, padding_ratio: float
) -> Float[np.ndarray, "3 3"]:
    """A_crop_img of the square centred on a box: ``padding_ratio`` times its longer side, scaled to ``size`` pixels."""
    x0, y0, x1, y1 = bbox_xyxy
    side = max(x1 - x0, y1 - y0) * padding_ratio
    scale = size / side
    left, top = (x0 + x1 - side) / 2, (y0 + y1 - side) / 2
    # the crop's left edge, -0.5, lies at ``left`` in the image
    return np.array([[scale, 0.0, -left * scale - 0.5], [0.0, scale, -top * scale - 0.5], [0.0, 0.0, 1.0]])


def virtual_crop(
    bbox_xyxy: tuple[float, float, float, float], K: Float[np.ndarray, "3 3"], *, size: int, padding_ratio: float
) -> Float[np.ndarray, "3 3"]:
    """A_crop_img = K_virtual R K^-1: the crop that a virtual camera takes, turned to look at the centre of a box.

    R is the smallest rotation from the box centre's ray to the optical axis. The focal length, equal in x and y, is
    chosen so that the square around the box, with ``padding_ratio`` times its longer side, just fits: its outermost
    corner lies on the crop's edge. Raises ValueError for a box that extends 90 degrees or more from its centre.
    """
    x0, y0, x1, y1 = bbox_xyxy
    half = max(x1 - x0, y1 - y0) * padding_ratio / 2
    centre = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
    corners = centre + half * np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
    rays = unproject(K, np.concatenate([centre[None], corners]), np.ones(5))
    R_virtual_cam = rotation_between(rays[0], np.array([0.0, 0.0, 1.0]))
    corner_rays = rays[1:] @ R_virtual_cam.T
    if corner_rays[:, 2].min() <= 0:
        raise ValueError("the box extends 90 degrees or more from its centre")
    focal = size / 2 / np.abs(corner_rays[:, :2] / corner_rays[:, 2:]).max()
    middle = (size - 1) / 2
    K_virtual = np.array([[focal, 0.0, middle], [0.0, focal, middle], [0.0, 0.0, 1.0]])
    return K_virtual @ R_virtual_cam @ np.linalg.inv(K)


def crop_camera(
    A_crop_img: Float[np.ndarray, "3 3"], K: Float[np.ndarray, "3 3"]
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"]]:
    """K_crop and R_crop_cam of the camera that would take the crop: A_crop_img K = K_crop R_crop_cam up to scale.

    Points p_crop = R_crop_cam @ p_cam project with K_crop to crop pixels; a crop that only scales and shifts has R = I.
    RQ decomposition with positive focal lengths: Hartley and Zisserman, "Multiple View Geometry", 2004, section 6.2.4.
    """
    P = A_crop_img @ K
    K_crop, R_crop_cam = scipy.linalg.rq(P * np.sign(np.linalg.det(P)))
    sign = np.sign(np.diag(K_crop))
    K_crop, R_crop_cam = K_crop * sign, sign[:, None] * R_crop_cam
    return K_crop / K_crop[2, 2], R_crop_cam


def local_zoom(A: Float[np.ndarray, "3 3"], px: Float[np.ndarray, "*m 2"]) -> Float[np.ndarray, "*m"]:
    """Magnification of a homography at pixels: square root of the factor by which it enlarges a small area there."""
    w = px @ A[2, :2] + A[2, 2]
    return np.asarray(np.sqrt(np.abs(np.linalg.det(A) / w**3)))


def mask_bbox(mask: Bool[np.ndarray, "H W"]) -> tuple[float, float, float, float] | None:
    """Box (x0, y0, x1, y1) around a mask, edges in pixels; None for an empty mask."""
    ys, xs = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(ys):
        return None
    return float(xs[0]) - 0.5, float(ys[0]) - 0.5, float(xs[-1]) + 0.5, float(ys[-1]) + 0.5


def cell_affine(*, size: int, cells: int) -> Float[np.ndarray, "3 3"]:
    """A_cell_crop: crop pixels to positions (column, row) on a map of ``cells`` x ``cells``; inverse of cell_to_px."""
    return resize_affine(cells / size)


def cell_to_px(cell_xy: Float[Tensor, "m 2"], *, size: int, cells: int) -> Float[Tensor, "m 2"]:
    """Crop pixels (x, y) of positions (column, row), possibly fractional, on a map of ``cells`` x ``cells``."""
    stride = size / cells
    return (cell_xy + 0.5) * stride - 0.5


def grid_xy(cell: Int[Tensor, " m"], *, width: int) -> Int[Tensor, "m 2"]:
    """(column, row) of flat cell indices of a map ``width`` cells wide."""
    import torch

    return torch.stack([cell % width, cell // width], dim=-1)
