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
    """Contract of a segment variant. ``makes_masks``: False where every box stays a box."""

    makes_masks: ClassVar[bool] = True

    @abstractmethod
    def __call__(self, rgb: UInt8[np.ndarray, "H W 3"], bbox_xyxy: BBox) -> Bool[np.ndarray, "H W"] | None:
        """The object's pixels in the image; None where the box says more than what was found in it."""

    def others(self, rgb: UInt8[np.ndarray, "H W 3"], bbox_xyxy: BBox) -> Iterator[Bool[np.ndarray, "H W"]]:
        """Further guesses at the mask, best first, for where poses with the first one do not convince."""
        return iter(())

    def is_enough(self, similarity: float) -> bool:
        """Whether no further guess is tried after a pose whose cells have this mean cosine with the query's."""
        return True
