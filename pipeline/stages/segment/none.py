"""image, box -> no mask."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from jaxtyping import UInt8

from pipeline.spec import spec
from pipeline.stages.segment import BBox, Segmenter


@spec
class NoSegmentation(Segmenter):
    """No mask: everything in the box counts as object, as in the paper's ablations."""

    kind: ClassVar[str] = "segment.none"
    version: ClassVar[int] = 1
    makes_masks: ClassVar[bool] = False

    def __call__(self, rgb: UInt8[np.ndarray, "H W 3"], bbox_xyxy: BBox) -> None:
        """None."""
        return
