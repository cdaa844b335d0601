"""image, box -> mask, by GrabCut."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, ClassVar

import cv2
import numpy as np
from jaxtyping import Bool, UInt8
from pydantic import Field

from pipeline.functional.boxes import pixels_inside
from pipeline.spec import Fraction, Positive, PositiveFloat, spec
from pipeline.stages.segment import BBox, Segmenter

MIN_SIDE_PX = 4  # smaller boxes have too few pixels for two colour models


@spec
class Grabcut(Segmenter):
    """GrabCut (Rother et al., SIGGRAPH 2004): colour models of the box and of its surroundings, and a graph cut.

    ``margin``: width of the surrounding frame, relative to the longer side of the box. ``side``: larger boxes are
    scaled down to this longer side, px. ``iterations``: of fitting and cutting. ``min_share``: smallest mask, as a
    share of the box; below it, the cut has failed. ``guesses``: most masks to try, until the features of a pose
    have a mean cosine of at least ``enough`` with the query's. Deterministic.
    """

    kind: ClassVar[str] = "segment.grabcut"
    version: ClassVar[int] = 1

    margin: PositiveFloat = 0.2
    side: Positive = 128
    iterations: Positive = 5
    min_share: Fraction = 0.15
    guesses: Annotated[int, Field(ge=1, le=3)] = 3
    enough: Fraction = 0.7

    def __call__(self, rgb: UInt8[np.ndarray, "H W 3"], bbox_xyxy: BBox) -> Bool[np.ndarray, "H W"] | None:
        """The object's pixels; None if the mask is below ``min_share`` or the box is tiny or fills the image."""
        return self._segment(rgb, bbox_xyxy, box_mask(bbox_xyxy, rgb.shape[:2]))

    def others(self, rgb: UInt8[np.ndarray, "H W 3"], bbox_xyxy: BBox) -> Iterator[Bool[np.ndarray, "H W"]]:
        """A cut that starts from the ellipse in the box, then the ellipse; ``guesses`` includes the first cut."""
        ellipse = ellipse_mask(bbox_xyxy, rgb.shape[:2])
        if self.guesses > 1 and (found := self._segment(rgb, bbox_xyxy, ellipse)) is not None:
            yield found
        if self.guesses > 2 and ellipse.any():
            yield ellipse

    def is_enough(self, similarity: float) -> bool:
        """As Segmenter.is_enough."""
        return similarity >= self.enough

    def _segment(
        self, rgb: UInt8[np.ndarray, "H W 3"], bbox_xyxy: BBox, start: Bool[np.ndarray, "H W"]
    ) -> Bool[np.ndarray, "H W"] | None:
        """The mask of a cut that starts with ``start`` as probable foreground."""
        (x0, y0, x1, y1), size_hw = bbox_xyxy, rgb.shape[:2]
        frame_px = self.margin * max(x1 - x0, y1 - y0)
        window = pixels_inside((x0 - frame_px, y0 - frame_px, x1 + frame_px, y1 + frame_px), size_hw)
        box = box_mask(bbox_xyxy, size_hw)
        if min(box.any(0).sum(), box.any(1).sum()) < MIN_SIDE_PX or box[window].all():
            return None
        mask = np.zeros_like(box)
        mask[window] = self._cut(rgb[window], box[window], start[window]) & box[window]
        return mask if mask.sum() >= self.min_share * box.sum() else None

    def _cut(
        self, rgb: UInt8[np.ndarray, "h w 3"], box: Bool[np.ndarray, "h w"], start: Bool[np.ndarray, "h w"]
    ) -> Bool[np.ndarray, "h w"]:
        """The foreground of a window; everything outside the box is background."""
        h, w = box.shape
        scale = min(1.0, self.side / max(box.any(0).sum(), box.any(1).sum()))
        size = max(2, round(w * scale)), max(2, round(h * scale))
        small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
        inside, probable = (
            cv2.resize(m.astype(np.float32), size, interpolation=cv2.INTER_AREA) >= 0.5 for m in (box, start)
        )
        label = np.where(inside, np.where(probable, cv2.GC_PR_FGD, cv2.GC_PR_BGD), cv2.GC_BGD).astype(np.uint8)
        if not (label == cv2.GC_PR_FGD).any() or not (label == cv2.GC_BGD).any():
            return np.zeros_like(box)
        models = np.zeros((1, 65)), np.zeros((1, 65))
        cv2.setRNGSeed(0)  # k-means of the colour models draws from OpenCV's generator
        cv2.grabCut(small, label, (0, 0, 1, 1), models[0], models[1], self.iterations, cv2.GC_INIT_WITH_MASK)
        found = ((label == cv2.GC_FGD) | (label == cv2.GC_PR_FGD)).astype(np.float32)
        return cv2.resize(found, (w, h), interpolation=cv2.INTER_LINEAR) >= 0.5


def box_mask(bbox_xyxy: BBox, size_hw: tuple[int, ...]) -> Bool[np.ndarray, "H W"]:
    """Pixels whose centre is in the box."""
    mask = np.zeros(size_hw, bool)
    mask[pixels_inside(bbox_xyxy, (size_hw[0], size_hw[1]))] = True
    return mask


def ellipse_mask(bbox_xyxy: BBox, size_hw: tuple[int, ...]) -> Bool[np.ndarray, "H W"]:
    """Pixels whose centre is in the ellipse inscribed in the box."""
    x0, y0, x1, y1 = bbox_xyxy
    y, x = np.mgrid[: size_hw[0], : size_hw[1]]
    across, down = (2 * x - x0 - x1) / max(x1 - x0, 1e-9), (2 * y - y0 - y1) / max(y1 - y0, 1e-9)
    return across**2 + down**2 <= 1
