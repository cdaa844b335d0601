"""Detections -> what is odd about them: no fault, and seldom meant. Said at the run's head and kept in its record."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.bop.masks import decode
from pipeline.graph.context import Context
from pipeline.items.views import Detection

FEW_PX = 16  # a mask of fewer pixels shows no shape
WHOLE = 0.98  # of the image: a mask that leaves nothing out is often inverted, or drawn in the wrong colour


def doubts(run: Context, detections: Sequence[Detection]) -> list[str]:
    """One line for each detection that is odd."""
    found = []
    for d in detections:
        if d.defect is None and (why := _doubt(run, d)):
            found.append(f"scene {d.scene_id}, image {d.im_id}, object {d.obj_id}: {why}")
    return found


def _doubt(run: Context, d: Detection) -> str:
    h, w = run.dataset.image_size(d.scene_id, d.im_id)
    if d.rle is None:
        x0, y0, x1, y1 = np.clip(d.bbox_xyxy, -0.5, (w - 0.5, h - 0.5, w - 0.5, h - 0.5))
        px, what = float(max(x1 - x0, 0) * max(y1 - y0, 0)), "box"
    else:
        px, what = float(decode(d.rle).sum()), "mask"
    if px < FEW_PX:
        return f"the {what} has {px:.0f} pixel{'s' if round(px) != 1 else ''}; a pose of so few says little"
    if px >= WHOLE * h * w:
        return f"the {what} covers {px / (h * w):.0%} of the image; is it the object's, and not inverted?"
    return ""
