"""Images under a scale and a translation, exact to the sub-pixel.

cv2.warpAffine rounds positions to 1/32 pixel and aliases when it shrinks; here each axis has its weights written out.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Shaped


def resample(
    image: Shaped[np.ndarray, "H W *c"], A_crop_img: Float[np.ndarray, "3 3"], *, size: int
) -> Float[np.ndarray, "S S *c"]:
    """The square crop of ``size`` pixels, 0 outside the image.

    Enlarged: bilinear. Shrunk: the mean over the area that the crop's pixel covers; both agree at scale 1.
    """
    height, width = image.shape[:2]
    wy = _weights(height, size=size, scale=A_crop_img[1, 1], shift=A_crop_img[1, 2])
    wx = _weights(width, size=size, scale=A_crop_img[0, 0], shift=A_crop_img[0, 2])
    rows, columns = _used(wy), _used(wx)
    part = image[rows, columns].astype(np.float32)
    lines = np.tensordot(wy[:, rows], part, axes=(1, 0))
    return np.moveaxis(np.tensordot(wx[:, columns], lines, axes=(1, 1)), 0, 1)


def _weights(pixels: int, *, size: int, scale: float, shift: float) -> Float[np.ndarray, "size pixels"]:
    """What each image pixel of an axis gives to each crop pixel."""
    centre = ((np.arange(size) - shift) / scale)[:, None]
    pixel = np.arange(pixels)
    if scale > 1:
        return np.clip(1 - np.abs(centre - pixel), 0, None).astype(np.float32)
    half = 0.5 / scale
    overlap = np.minimum(centre + half, pixel + 0.5) - np.maximum(centre - half, pixel - 0.5)
    return (np.clip(overlap, 0, None) * scale).astype(np.float32)


def _used(weights: Float[np.ndarray, "size pixels"]) -> slice:
    index = np.flatnonzero(weights.any(0))
    return slice(int(index[0]), int(index[-1]) + 1) if len(index) else slice(0, 0)
