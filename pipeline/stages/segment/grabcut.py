"""image, box -> mask, by GrabCut."""

from __future__ import annotations

from typing import ClassVar

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from pipeline.functional.boxes import pixels_inside
from pipeline.spec import Fraction, Positive, PositiveFloat, spec
from pipeline.stages.segment import BBox, Segmenter

MIN_SIDE_PX = 4  # smaller boxes have too few pixels for two colour models


@spec
class Grabcut(Segmenter):
    """GrabCut (Rother et al., SIGGRAPH 2004): two colour models, of the box and of what surrounds it, and a graph cut.

    ``margin``: width of the surrounding frame, in longer sides of the box. ``side``: larger boxes are scaled down to
    this many pixels a side. ``iterations``: of fitting and cutting. ``min_share``: of the box; a smaller mask is
    refused, because the cut has then found a part or nothing. The same image and box give the same mask.
    """

    kind: ClassVar[str] = "segment.grabcut"
    version: ClassVar[int] = 1

    margin: PositiveFloat = 0.2
    side: Positive = 128
    iterations: Positive = 5
    min_share: Fraction = 0.15

    def __call__(self, rgb: UInt8[np.ndarray, "H W 3"], bbox_xyxy: BBox) -> Bool[np.ndarray, "H W"] | None:
        """The object's pixels; None for a mask below ``min_share``, a tiny box, and one that fills the image."""
        (x0, y0, x1, y1), size_hw = bbox_xyxy, (rgb.shape[0], rgb.shape[1])
        frame_px = self.margin * max(x1 - x0, y1 - y0)
        window = pixels_inside((x0 - frame_px, y0 - frame_px, x1 + frame_px, y1 + frame_px), size_hw)
        inner = pixels_inside(bbox_xyxy, size_hw)
        box = np.zeros(size_hw, bool)
        box[inner] = True
        if min(box[inner].shape) < MIN_SIDE_PX or box[window].all():
            return None
        mask = np.zeros_like(box)
        mask[window] = self._cut(rgb[window], box[window]) & box[window]
        return mask if mask.sum() >= self.min_share * box.sum() else None

    def _cut(self, rgb: UInt8[np.ndarray, "h w 3"], box: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
        """The foreground of a window; outside the box everything is background."""
        h, w = box.shape
        scale = min(1.0, self.side / max(box.any(0).sum(), box.any(1).sum()))
        size = max(2, round(w * scale)), max(2, round(h * scale))
        small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
        inside = cv2.resize(box.astype(np.float32), size, interpolation=cv2.INTER_AREA) >= 0.5
        label = np.where(inside, cv2.GC_PR_FGD, cv2.GC_BGD).astype(np.uint8)
        models = np.zeros((1, 65)), np.zeros((1, 65))
        cv2.setRNGSeed(0)  # k-means of the colour models draws from OpenCV's generator
        cv2.grabCut(small, label, (0, 0, 1, 1), models[0], models[1], self.iterations, cv2.GC_INIT_WITH_MASK)
        found = ((label == cv2.GC_FGD) | (label == cv2.GC_PR_FGD)).astype(np.float32)
        return cv2.resize(found, (w, h), interpolation=cv2.INTER_LINEAR) >= 0.5
