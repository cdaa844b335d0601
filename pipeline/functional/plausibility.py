"""Sanity checks of photograph, mask and size: what cannot be right, and which mistake would explain it."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

NEAR_MM, FAR_MM = 120.0, 10_000.0  # plausible distances of an object that a camera is pointed at
FAR_OFF = 2.5  # ratio of measured depth and distance by size
LEAST_RANGE, LEAST_DETAIL = 12.0, 1.5  # of 255 grey levels; on LM-O's and YCB-V's objects at least 24 and 4.5
FLAT = 1e-3  # smallest over largest extent; below this, a mesh counts as a sheet
_DETAIL_PX, _SIGMA_PX = 128, 4.0  # size at which detail is measured, and of what counts as detail
_UNITS = {"metres": 1000.0, "inches": 25.4, "centimetres": 10.0}


def diagnose_contrast(rgb: UInt8[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"]) -> str:
    """What is wrong with the pixels of the mask if they show one colour or a smooth gradient; "" for any other.

    A pose is found all the same, from the outline, and may get a high confidence.
    """
    grey, inside = _crop_grey(rgb, mask)
    if not inside.any():
        return ""
    low, high = np.percentile(grey[inside], [5, 95])
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), _SIGMA_PX)
    detail = float((grey - smooth)[inside].std())
    if high - low >= LEAST_RANGE and detail >= LEAST_DETAIL:
        return ""
    levels = f"grey levels vary by {high - low:.0f} of 255, details by {detail:.1f}"
    return f"the photograph shows almost nothing there ({levels}), so the pose rests on the outline alone"


def _crop_grey(
    rgb: UInt8[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"]
) -> tuple[UInt8[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Grey values and mask around the mask, at most _DETAIL_PX a side; empty for an empty mask."""
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return np.zeros((0, 0), np.uint8), np.zeros((0, 0), bool)
    around = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    grey, inside = cv2.cvtColor(np.ascontiguousarray(rgb[around]), cv2.COLOR_RGB2GRAY), mask[around]
    scale = _DETAIL_PX / max(grey.shape)
    if scale >= 1:
        return grey, inside
    size = max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale))
    small = cv2.resize(inside.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA)), small > 0


def diagnose_distance(distance_mm: float) -> str:
    """Why the object cannot be this far from the camera, and the units that would explain it; "" if it can."""
    if NEAR_MM <= distance_mm <= FAR_MM:
        return ""
    fitting = [name for name, factor in _UNITS.items() if 1.5 * NEAR_MM <= distance_mm * factor <= FAR_MM / 3]
    return f"check K; or is the mesh in {' or '.join(fitting)}?" if fitting else "check K and the mesh's unit"


def distance_text(distance_mm: float, located_by: str) -> str:
    """A distance that follows from the sizes of the mesh and of its mask or box (``located_by``)."""
    return f"mesh, K and {located_by} give a distance of about {distance_mm / 1000:.3g} m"


def estimate_distance(diameter_mm: float, focal_px: float, extent_px: float) -> float:
    """Distance (mm) at which an object of this diameter appears as large as its mask; it is nearer if occluded."""
    return focal_px * diameter_mm / extent_px


def diagnose_depth(depth_mm: Float[np.ndarray, " n"], distance_mm: float) -> str:
    """Why measured depths cannot be the object's, and the scale that would explain it; "" if they can.

    ``depth_mm``: those known inside its mask or box. ``distance_mm``: by its size; occlusion and pose change it less.
    """
    if not len(depth_mm):
        return ""
    ratio = distance_mm / float(np.median(depth_mm))
    if 1 / FAR_OFF < ratio < FAR_OFF:
        return ""
    fitting = [f for f in (1000.0, 100.0, 10.0, 0.1, 0.01, 0.001) if 0.5 < ratio / f < 2]
    if not fitting:
        return "check K, the mask and the depth scale"
    return f"dataset.depth_scale={fitting[0]:g} times the present one fits"


def diagnose_shape(vertices: Float[np.ndarray, "v 3"]) -> str:
    """What a mesh without thickness cannot show; "" for any other. ``vertices``: mm."""
    centred = vertices - vertices.mean(axis=0)
    axes = np.linalg.eigh(centred.T @ centred)[1]
    extents = np.sort(np.ptp(centred @ axes, axis=0))[::-1]
    if extents[2] >= FLAT * extents[0]:
        return ""
    sides = " x ".join(f"{extent:.3g}" for extent in np.where(extents < 1e-6 * extents[0], 0, extents))
    what = "a line" if extents[1] < 10 * FLAT * extents[0] else "flat"
    return f"it is {what} ({sides} mm): poses that show its edge or its back are wrong; use a mesh with thickness"
