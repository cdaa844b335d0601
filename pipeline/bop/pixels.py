"""Stored pixel values -> 8-bit intensities, or the mask of one object. All rules for both are in this module."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Shaped, UInt8

from pipeline.errors import BadInput

MAX_MEGAPIXELS = 300
BIT_DEPTHS = (8, 10, 12, 14, 16)
DEEP_GREY_VERSION = 2
"""Version of ``scale_to_8_bits``; in version 1 white was 65535. ``select_object`` counts as part of the detectors."""
NEAR = 0.03  # share of the largest value: compression shifts flat black or white by less
SMALLEST_WHITE = 128  # integers below it are labels, not intensities
_JUMP = 0.1  # share of the largest value: a soft edge rises less from one pixel to the next
COLOUR_NEAR = 0.4  # share of the largest value: compression shifts the colour of a mask by less
MAX_LABELS_SHOWN = 8


def check_megapixels(width: int, height: int, path: Path) -> None:
    """Raise BadInput for an image that would not fit in memory together with what is computed from it."""
    megapixels = width * height / 1e6
    if megapixels > MAX_MEGAPIXELS:
        found = f"{width} x {height} pixels, {megapixels:.0f} megapixels"
        raise BadInput(path, found=found, needed=f"at most {MAX_MEGAPIXELS}: scale the image down, and K with it")


def scale_to_8_bits(values: Shaped[np.ndarray, "H W"], path: Path) -> UInt8[np.ndarray, "H W"]:
    """Grey values of more than 8 bits -> 0..255.

    Integers are taken to have the smallest usual number of bits (8, 10, 12, 14, 16) that holds the largest of them, so
    that 4095 is white in the 12 bits of an industrial camera. Floating point numbers up to 1 are fractions of white,
    larger ones are taken as integers. Raises BadInput for negative values and for those beyond 16 bits.
    """
    largest, smallest = (float(values.max()), float(values.min())) if values.size else (0.0, 0.0)
    if not np.isfinite([largest, smallest]).all() or smallest < 0 or largest >= 1 << BIT_DEPTHS[-1]:
        found = f"pixel values from {smallest:g} to {largest:g}"
        raise BadInput(path, found=found, needed="grey values of 8 to 16 bits, or floating point values from 0 to 1")
    if values.dtype.kind == "f" and largest <= 1:
        white = 1.0
    else:
        white = float((1 << next(bits for bits in BIT_DEPTHS if largest < 1 << bits)) - 1)
    return np.round(values.astype(np.float64) * (255 / white)).clip(0, 255).astype(np.uint8)


def select_object(
    values: Shaped[np.ndarray, "H W *c"], path: Path, *, label: int | None = None
) -> Bool[np.ndarray, "H W"]:
    """The pixels of the object in a mask.

    Two values: the object is where the mask is not black. More values, as compression and soft edges leave them: the
    object is above half of the largest. An image with flat regions of several values, or with several small integers,
    labels instances: ``label`` chooses one, and without it BadInput lists the labels. A photograph, whole or cut out on
    black, is refused.
    """
    grey = values if values.ndim == 2 else values.max(axis=-1)
    if not np.isfinite(grey).all() or (grey.size and grey.min() < 0):
        raise BadInput(path, found="negative or undefined values", needed="a mask: black outside the object")
    if label is not None:
        return _select_label(grey, label, path)
    largest = float(grey.max(initial=0))
    object_px = np.count_nonzero(grey)
    if object_px == 0 or (np.count_nonzero(grey == largest) == object_px and _one_colour(values, grey > 0)):
        return np.asarray(grey > 0)
    bright = np.asarray(grey >= largest / 2)
    intensities = grey.dtype.kind == "f" or largest >= SMALLEST_WHITE
    if intensities and not _has_plateau(grey, largest) and _one_colour(values, bright):
        if _is_photograph(grey, largest):
            needed = "a mask: white on the object, black elsewhere"
            raise BadInput(path, found="the shades of a photograph, whole or cut out", needed=needed)
        return bright
    raise _labels_error(values, grey, path)


def _is_photograph(grey: Shaped[np.ndarray, "H W"], largest: float) -> bool:
    """Whether most non-black pixels are grey, and not because of soft edges.

    A soft edge rises gradually from black; a photograph cut out on black begins with its own shades, and a whole one
    has hardly any black.
    """
    values = grey.astype(np.float32) / np.float32(largest)
    black = values <= NEAR
    between = float((values[~black] < 1 - NEAR).mean()) if not black.all() else 0.0
    beside_black = (cv2.dilate(black.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & ~black
    rise = float(np.median(values[beside_black])) if beside_black.any() else 0.0
    return bool((between > 0.5 and rise > _JUMP) or (between > 0.9 and black.mean() < 0.2))


def _has_plateau(grey: Shaped[np.ndarray, "H W"], largest: float) -> bool:
    """Whether there is a flat grey region: labels have them, soft edges do not."""
    values = grey.astype(np.float32)
    square = np.ones((3, 3), np.uint8)
    flat = cv2.erode(values, square) == cv2.dilate(values, square)
    return bool((flat & (values > NEAR * largest) & (values < (1 - NEAR) * largest)).any())


def _one_colour(values: Shaped[np.ndarray, "H W *c"], inside: Bool[np.ndarray, "H W"]) -> bool:
    """Whether most pixels inside have nearly the same colour."""
    if values.ndim == 2 or not inside.any():
        return True
    colours = values[inside].astype(np.float64)
    off = np.abs(colours - np.median(colours, axis=0)).max(axis=-1)
    return bool(np.mean(off <= COLOUR_NEAR * max(colours.max(), 1)) > 0.9)


def _select_label(grey: Shaped[np.ndarray, "H W"], label: int, path: Path) -> Bool[np.ndarray, "H W"]:
    mask = np.asarray(grey == label)
    if not mask.any():
        raise BadInput("dataset.mask_label", found=label, needed=f"one of the labels of {path}: {_list_labels(grey)}")
    return mask


def _labels_error(values: Shaped[np.ndarray, "H W *c"], grey: Shaped[np.ndarray, "H W"], path: Path) -> BadInput:
    needed = "the mask of one object, or dataset.mask_label=N to choose a label"
    if values.ndim == 3 and not (values == values[..., :1]).all():
        colours = len(np.unique(values[grey > 0].reshape(-1, values.shape[-1])[:: max(1, grey.size // 10**6)], axis=0))
        return BadInput(path, found=f"{colours} colours beside black", needed="the mask of one object, white on black")
    return BadInput(path, found=f"several values beside black: {_list_labels(grey)}", needed=needed)


def _list_labels(grey: Shaped[np.ndarray, "H W"]) -> str:
    labels, counts = np.unique(grey[grey > 0], return_counts=True)
    shown = [f"{label:g} ({count} pixels)" for label, count in zip(labels, counts, strict=True)][:MAX_LABELS_SHOWN]
    more = len(labels) - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more else "") if len(labels) else "none"
