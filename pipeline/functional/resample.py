"""Images under a scale and a translation, or a homography, exact to the sub-pixel.

cv2.warpAffine rounds positions to 1/32 pixel and aliases when it shrinks; here each axis has its weights written out.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Shaped

from pipeline.functional.camera import apply_homography, local_zoom

_FINEST = 16  # samples a side of a crop pixel at most: a crop that shrinks by more shows nothing anyway


def resample(
    image: Shaped[np.ndarray, "H W *c"], A_crop_img: Float[np.ndarray, "3 3"], *, size: int
) -> Float[np.ndarray, "S S *c"]:
    """The square crop of ``size`` pixels, 0 outside the image.

    Enlarged: bilinear. Shrunk: the mean over the area that the crop's pixel covers; both agree at scale 1.
    """
    height, width = image.shape[:2]
    wy = _axis_weights(height, size=size, scale=A_crop_img[1, 1], shift=A_crop_img[1, 2])
    wx = _axis_weights(width, size=size, scale=A_crop_img[0, 0], shift=A_crop_img[0, 2])
    rows, columns = _nonzero_columns(wy), _nonzero_columns(wx)
    part = image[rows, columns].astype(np.float32)
    lines = np.tensordot(wy[:, rows], part, axes=(1, 0))
    return np.moveaxis(np.tensordot(wx[:, columns], lines, axes=(1, 1)), 0, 1)


def warp(
    image: Shaped[np.ndarray, "H W *c"], A_crop_img: Float[np.ndarray, "3 3"], *, size: int
) -> Float[np.ndarray, "S S *c"]:
    """The square crop of ``size`` pixels under any homography, 0 outside the image.

    Enlarged: bilinear, as ``resample``. Shrunk: the mean of n x n bilinear samples spread over the crop's pixel, n the
    least with no sample more than an image pixel from the next; a touch softer than ``resample``'s mean over the area.
    """
    grid = np.stack(np.meshgrid(np.arange(size), np.arange(size)), axis=-1).reshape(-1, 2).astype(float)
    A_img_crop = np.linalg.inv(A_crop_img)
    corners = np.array([[-0.5, -0.5], [size - 0.5, -0.5], [-0.5, size - 0.5], [size - 0.5, size - 0.5]])
    n = int(np.clip(np.ceil(local_zoom(A_img_crop, corners).max() - 1e-6), 1, _FINEST))
    offsets = (np.arange(n) + 0.5) / n - 0.5
    pixels = np.pad(image.reshape(*image.shape[:2], -1).astype(np.float32), ((2, 2), (2, 2), (0, 0)))
    samples = (
        _bilinear(pixels, apply_homography(A_img_crop, grid + np.array([x, y]))) for y in offsets for x in offsets
    )
    total = sum(samples, np.zeros((size * size, pixels.shape[2]), np.float32))
    return (total / np.float32(n * n)).reshape(size, size, *image.shape[2:])


def _bilinear(pixels: Float[np.ndarray, "rows columns c"], px: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m c"]:
    """Values between the four nearest pixels of an image that has two more rows and columns of zeros on each side."""
    low = np.floor(px)
    x, y = (px - low).astype(np.float32).T[..., None]
    rows, columns, _ = pixels.shape
    column, row = low.clip(-2, [columns - 4, rows - 4]).astype(np.int64).T + 2  # far away is where two zeros meet
    flat = pixels.reshape(rows * columns, -1)
    a, b, c, d = (flat.take(row * columns + column + step, axis=0) for step in (0, 1, columns, columns + 1))
    upper, lower = a + x * (b - a), c + x * (d - c)
    return upper + y * (lower - upper)


def _axis_weights(pixels: int, *, size: int, scale: float, shift: float) -> Float[np.ndarray, "size pixels"]:
    """What each image pixel of an axis gives to each crop pixel."""
    centre = ((np.arange(size) - shift) / scale)[:, None]
    pixel = np.arange(pixels)
    if scale > 1:
        return np.clip(1 - np.abs(centre - pixel), 0, None).astype(np.float32)
    half = 0.5 / scale
    overlap = np.minimum(centre + half, pixel + 0.5) - np.maximum(centre - half, pixel - 0.5)
    return (np.clip(overlap, 0, None) * scale).astype(np.float32)


def _nonzero_columns(weights: Float[np.ndarray, "size pixels"]) -> slice:
    index = np.flatnonzero(weights.any(0))
    return slice(int(index[0]), int(index[-1]) + 1) if len(index) else slice(0, 0)
