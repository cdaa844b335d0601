"""Boxes (x0, y0, x1, y1), edges in pixels: pixels inside, area, overlap and non-maximum suppression."""

from __future__ import annotations

from math import ceil, floor

import numpy as np
from jaxtyping import Bool, Float


def pixels_inside(box: tuple[float, float, float, float], size_hw: tuple[int, int]) -> tuple[slice, slice]:
    """Rows and columns of the image's pixels whose centre is in the box; empty slices where there are none."""
    (x0, y0, x1, y1), (h, w) = box, size_hw
    rows = slice(max(0, ceil(y0)), max(0, min(h, floor(y1) + 1)))
    return rows, slice(max(0, ceil(x0)), max(0, min(w, floor(x1) + 1)))


def area(boxes: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, " n"]:
    """Areas in square pixels; 0 for an empty or inverted box."""
    return np.prod(np.maximum(boxes[:, 2:] - boxes[:, :2], 0.0), axis=1)


def iou(box: Float[np.ndarray, " 4"], boxes: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, " n"]:
    """Intersection over union of one box with each of ``boxes``; 0 where both have no area."""
    shared = area(np.concatenate([np.maximum(box[:2], boxes[:, :2]), np.minimum(box[2:], boxes[:, 2:])], axis=1))
    union = area(box[None]) + area(boxes) - shared
    return np.divide(shared, union, out=np.zeros(len(boxes)), where=union > 0)


def non_maximum_suppression(
    boxes: Float[np.ndarray, "n 4"], score: Float[np.ndarray, " n"], *, max_iou: float
) -> Bool[np.ndarray, " n"]:
    """Greedy non-maximum suppression: True for each box whose IoU with every better kept box is at most ``max_iou``.

    Ties in score go to the box that comes first.
    """
    keep = np.zeros(len(boxes), bool)
    remaining = np.argsort(-score, kind="stable")
    while len(remaining):
        best, remaining = remaining[0], remaining[1:]
        keep[best] = True
        remaining = remaining[iou(boxes[best], boxes[remaining]) <= max_iou]
    return keep
