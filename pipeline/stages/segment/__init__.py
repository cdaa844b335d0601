"""image, box -> mask, for detections without a mask."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import ClassVar

import numpy as np
from jaxtyping import Bool, UInt8

from pipeline.spec import Spec

BBox = tuple[float, float, float, float]


class Segmenter(Spec, ABC):
    """Contract of a segment variant. ``makes_masks``: False if boxes are used as they are."""

    makes_masks: ClassVar[bool] = True

    @abstractmethod
    def __call__(self, rgb: UInt8[np.ndarray, "H W 3"], bbox_xyxy: BBox) -> Bool[np.ndarray, "H W"] | None:
        """The object's pixels in the image; None if no useful mask was found, so that the box is used."""

    def others(self, rgb: UInt8[np.ndarray, "H W 3"], bbox_xyxy: BBox) -> Iterator[Bool[np.ndarray, "H W"]]:
        """Further guesses at the mask, best first, tried while poses are not good enough."""
        return iter(())

    def is_enough(self, similarity: float) -> bool:
        """Whether a pose with this mean cosine to the query's features is good enough to stop trying guesses."""
        return True
