"""Is K plausible for an image, and if not, which mistake would explain it?"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipeline.functional.camera import resize_affine

MAX_OFFSET = 0.15  # of the principal point from the image's centre, as a share of the image's side
MAX_RATIO = 1.2  # between fx and fy
CLOSE = 0.1  # relative difference of two numbers that should be equal
_COMMON_SCALES = (
    1 / 8,
    1 / 6,
    1 / 5,
    1 / 4,
    1 / 3,
    3 / 8,
    1 / 2,
    2 / 3,
    3 / 4,
    4 / 3,
    1.5,
    2.0,
    8 / 3,
    3.0,
    4.0,
    6.0,
    8.0,
)
_QUARTER_TURNS = (5, 6, 7, 8)  # EXIF orientations that exchange width and height

Intrinsics = tuple[float, float, float, float]
"""fx, fy, cx, cy in pixels."""


def diagnose_camera(K: Float[np.ndarray, "3 3"], size_hw: tuple[int, int], *, exif_orientation: int = 1) -> str:
    """What is implausible about K, the likely cause, and the K that would fit; "" for a plausible K.

    Implausible: a principal point more than 15 % of a side off the image's centre, or 10 % where cx and cy would be
    central if exchanged, fx and fy that differ by more than a fifth, or a K that fits the stored image better than the
    upright one where EXIF turns it. ``size_hw`` is that of the upright image.
    """
    given = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
    h, w = size_hw
    fx, fy, cx, cy = given
    found = f"K [{_text(given)}] is unusual for an image of {w} x {h} (width x height)"
    turned = exif_orientation in _QUARTER_TURNS
    sensor = turned and _offset(given, size_hw[::-1]) < _offset(given, size_hw)
    if _is_plausible(given, size_hw) and not sensor:
        exchanged = (fx, fy, cy, cx)
        if _offset(given, size_hw) < CLOSE or _offset(exchanged, size_hw) > CLOSE / 2:
            return ""
        return f"{found}; cx and cy look exchanged: [{_text(exchanged)}]"
    if sensor or (w != h and _is_plausible(given, size_hw[::-1])):
        fitting = _turn(given, size_hw, exif_orientation)
        reason = "EXIF turns this photograph upright" if turned else "the picture may have been turned by 90 degrees"
        return f"{found}; it fits the sensor's {h} x {w}: {reason}, where K would be about [{_text(fitting)}]"
    for order, values in (("fx, cx, fy, cy", (fx, cx, fy, cy)), ("cx, cy, fx, fy", (cx, cy, fx, fy))):
        if _is_plausible(values, size_hw):
            return f"{found}; its order looks like {order}, and needs to be fx, fy, cx, cy: [{_text(values)}]"
    if rescaled := _rescale(given, size_hw):
        scale = fx / rescaled[0]
        other = f"{round(w * scale)} x {round(h * scale)}"
        return f"{found}; it looks like the K of an image of {other}: for this one [{_text(rescaled)}]"
    from_centre = (fx, fy, cx + (w - 1) / 2, cy + (h - 1) / 2)
    if _is_plausible(from_centre, size_hw):
        return f"{found}; measured from the image's centre? From its upper left corner it is [{_text(from_centre)}]"
    if _offset(given, size_hw) > MAX_OFFSET:
        return (
            f"{found}: the principal point is far from the centre; was the image cropped or resized after calibration?"
        )
    return f"{found}: fx and fy differ by a factor of {max(fx / fy, fy / fx):.2f}; was the image stretched?"


def denormalize_camera(K: Float[np.ndarray, "3 3"], size_hw: tuple[int, int]) -> Intrinsics | None:
    """Intrinsics in pixels of a K that was divided by the image's width and height; None for any other K."""
    h, w = size_hw
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    values = (float(fx * w), float(fy * h), float(cx * w), float(cy * h))
    return (
        values if max(abs(fx), abs(fy)) < 10 and 0 < cx < 1 and 0 < cy < 1 and _is_plausible(values, size_hw) else None
    )


def _is_plausible(values: Intrinsics, size_hw: tuple[int, int]) -> bool:
    fx, fy, _, _ = values
    longer = max(size_hw)
    focal = all(0.3 * longer < f < 20 * longer for f in (fx, fy))
    return focal and max(fx / fy, fy / fx) <= MAX_RATIO and _offset(values, size_hw) <= MAX_OFFSET


def _offset(values: Intrinsics, size_hw: tuple[int, int]) -> float:
    """Largest distance of the principal point from the centre, as a share of that side."""
    h, w = size_hw
    return max(abs(values[2] - (w - 1) / 2) / w, abs(values[3] - (h - 1) / 2) / h)


def _turn(values: Intrinsics, size_hw: tuple[int, int], exif_orientation: int) -> Intrinsics:
    """The sensor's intrinsics in the upright image; counter-clockwise for orientations 5 and 8, else clockwise."""
    h, w = size_hw
    fx, fy, cx, cy = values
    x = cy if exif_orientation in (5, 8) else w - 1 - cy
    y = h - 1 - cx if exif_orientation in (7, 8) else cx
    return fy, fx, x, y


def _rescale(values: Intrinsics, size_hw: tuple[int, int]) -> Intrinsics | None:
    """Intrinsics scaled so that the principal point is central, where one scale serves both sides."""
    h, w = size_hw
    fx, fy, cx, cy = values
    scale_x, scale_y = (cx + 0.5) * 2 / w, (cy + 0.5) * 2 / h
    if min(scale_x, scale_y) <= 0.02 or abs(scale_x / scale_y - 1) > CLOSE:
        return None
    scale = min(_COMMON_SCALES, key=lambda common: abs(scale_x / common - 1))
    scale = scale if abs(scale_x / scale - 1) < CLOSE else scale_x
    scaled = resize_affine(1 / scale) @ np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    fitting = (float(scaled[0, 0]), float(scaled[1, 1]), float(scaled[0, 2]), float(scaled[1, 2]))
    return fitting if _is_plausible(fitting, size_hw) else None


def _text(values: Intrinsics) -> str:
    return ", ".join(f"{value:.6g}" for value in values)
