"""Antialiased crops of images under scale and translation, or under a homography, with exact sub-pixel positions.

cv2.warpAffine rounds positions to 1/32 pixel and aliases when it shrinks.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Shaped

from pipeline.functional.camera import apply_homography, local_zoom

_MAX_SAMPLES = 16  # samples per axis and crop pixel; an object shrunk by more is not recognisable


def resample(
    image: Shaped[np.ndarray, "H W *c"], A_crop_img: Float[np.ndarray, "3 3"], *, size: int
) -> Float[np.ndarray, "S S *c"]:
    """Square crop of ``size`` x ``size`` pixels, float32, 0 outside the image. A_crop_img must only scale and shift.

    Enlarging is bilinear; shrinking averages over the area that a crop pixel covers. Both agree at scale 1.
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
    """Square crop of ``size`` x ``size`` pixels under any homography, float32, 0 outside the image.

    Enlarging is bilinear, as in ``resample``. Shrinking averages n x n bilinear samples per crop pixel, with the
    smallest n that puts samples at most one image pixel apart; slightly softer than ``resample``'s area mean.
    """
    grid = np.stack(np.meshgrid(np.arange(size), np.arange(size)), axis=-1).reshape(-1, 2).astype(float)
    A_img_crop = np.linalg.inv(A_crop_img)
    corners = np.array([[-0.5, -0.5], [size - 0.5, -0.5], [-0.5, size - 0.5], [size - 0.5, size - 0.5]])
    n = int(np.clip(np.ceil(local_zoom(A_img_crop, corners).max() - 1e-6), 1, _MAX_SAMPLES))
    offsets = (np.arange(n) + 0.5) / n - 0.5
    pixels = np.pad(image.reshape(*image.shape[:2], -1).astype(np.float32), ((2, 2), (2, 2), (0, 0)))
    samples = (
        _bilinear(pixels, apply_homography(A_img_crop, grid + np.array([x, y]))) for y in offsets for x in offsets
    )
    total = sum(samples, np.zeros((size * size, pixels.shape[2]), np.float32))
    return (total / np.float32(n * n)).reshape(size, size, *image.shape[2:])


def _bilinear(pixels: Float[np.ndarray, "rows columns c"], px: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m c"]:
    """Values at ``px``, pixels (x, y) of the image without padding; ``pixels`` is padded with 2 zeros on every side."""
    low = np.floor(px)
    x, y = (px - low).astype(np.float32).T[..., None]
    rows, columns, _ = pixels.shape
    column, row = low.clip(-2, [columns - 4, rows - 4]).astype(np.int64).T + 2  # positions far outside clamp to zeros
    flat = pixels.reshape(rows * columns, -1)
    a, b, c, d = (flat.take(row * columns + column + step, axis=0) for step in (0, 1, columns, columns + 1))
    upper, lower = a + x * (b - a), c + x * (d - c)
    return upper + y * (lower - upper)


def _axis_weights(pixels: int, *, size: int, scale: float, shift: float) -> Float[np.ndarray, "size pixels"]:
    """Weight of each image pixel in each crop pixel, along one axis."""
    centre = ((np.arange(size) - shift) / scale)[:, None]
    pixel = np.arange(pixels)
    if scale > 1:
        return np.clip(1 - np.abs(centre - pixel), 0, None).astype(np.float32)
    half = 0.5 / scale
    overlap = np.minimum(centre + half, pixel + 0.5) - np.maximum(centre - half, pixel - 0.5)
    return (np.clip(overlap, 0, None) * scale).astype(np.float32)


def _nonzero_columns(weights: Float[np.ndarray, "size pixels"]) -> slice:
    """Range of image pixels with a weight."""
    index = np.flatnonzero(weights.any(0))
    return slice(int(index[0]), int(index[-1]) + 1) if len(index) else slice(0, 0)
