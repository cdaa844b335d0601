"""Detections -> what is odd about them: no fault, and seldom meant. Said at the run's head and kept in its record."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.bop.masks import decode_rle
from pipeline.graph.context import Context, ImageId
from pipeline.items.views import Detection

FEW_PX = 16  # a mask of fewer pixels shows no shape
WHOLE = 0.98  # of the image: a mask that leaves nothing out is often inverted, or drawn in the wrong colour
HALF = 0.5  # of the image: one that also reaches all four sides is often the background
OUTSIDE = 0.1  # of a box beyond the image: often two corners instead of a corner, width and height


def detection_warnings(context: Context, detections: Sequence[Detection]) -> list[str]:
    """One line for each detection that is odd, and for each camera whose poses nothing vouches for."""
    found = []
    for scene_id, im_id in dict.fromkeys((d.scene_id, d.im_id) for d in detections):
        if not context.dataset.has_ground_truth(scene_id) and (why := _camera_doubt(context, (scene_id, im_id))):
            found.append(f"scene {scene_id}, image {im_id}: {why}")
    for d in detections:
        if d.defect is None and (why := _doubt(context, d)):
            found.append(f"scene {d.scene_id}, image {d.im_id}, object {d.obj_id}: {why}")
    return found


def _camera_doubt(context: Context, image: ImageId) -> str:
    (h, w), (cx, cy) = context.dataset.image_size(*image), context.K(image)[:2, 2]
    if 0 <= cx <= w and 0 <= cy <= h:
        return ""
    where = f"({cx:g}, {cy:g}) lies outside the image of {w} x {h} (width x height)"
    return f"K's principal point {where}; is it the K of this image at this size?"


def _doubt(context: Context, d: Detection) -> str:
    h, w = context.dataset.image_size(d.scene_id, d.im_id)
    round_all = False
    if d.rle is None:
        x0, y0, x1, y1 = np.clip(d.bbox_xyxy, -0.5, (w - 0.5, h - 0.5, w - 0.5, h - 0.5))
        px, what = float(max(x1 - x0, 0) * max(y1 - y0, 0)), "box"
        left, top, right, bottom = d.bbox_xyxy
        if context.dataset.given_bbox_xyxy and px < (1 - OUTSIDE) * (right - left) * (bottom - top):
            share = 1 - px / ((right - left) * (bottom - top))
            return f"{share:.0%} of the box lies outside the image; is it x, y, width, height, and not two corners?"
    else:
        mask = decode_rle(d.rle)
        px, what = float(mask.sum()), "mask"
        round_all = all(side.any() for side in (mask[0], mask[-1], mask[:, 0], mask[:, -1]))
    if px < FEW_PX:
        return f"the {what} has {px:.0f} pixel{'s' if round(px) != 1 else ''}; a pose of so few says little"
    if px >= WHOLE * h * w or (round_all and px >= HALF * h * w):
        return f"the {what} covers {px / (h * w):.0%} of the image; is it the object's, and not inverted?"
    return ""
