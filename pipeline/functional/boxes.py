"""Boxes (x0, y0, x1, y1) by their edges, in pixels: overlap, and which of many that overlap stay."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float


def area(boxes: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, " n"]:
    """Square pixels; 0 for a box whose edges cross."""
    return np.prod(np.maximum(boxes[:, 2:] - boxes[:, :2], 0.0), axis=1)


def iou(box: Float[np.ndarray, " 4"], boxes: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, " n"]:
    """Intersection over union of one box with each of ``boxes``; 0 where both are without area."""
    shared = area(np.concatenate([np.maximum(box[:2], boxes[:, :2]), np.minimum(box[2:], boxes[:, 2:])], axis=1))
    union = area(box[None]) + area(boxes) - shared
    return np.divide(shared, union, out=np.zeros(len(boxes)), where=union > 0)


def non_maximum_suppression(
    boxes: Float[np.ndarray, "n 4"], score: Float[np.ndarray, " n"], *, max_iou: float
) -> Bool[np.ndarray, " n"]:
    """Greedy non-maximum suppression: the boxes that overlap no better one that stays by more than ``max_iou``.

    Of equal scores the first is the better one.
    """
    kept = np.zeros(len(boxes), bool)
    left = np.argsort(-score, kind="stable")
    while len(left):
        best, left = left[0], left[1:]
        kept[best] = True
        left = left[iou(boxes[best], boxes[left]) <= max_iou]
    return kept
