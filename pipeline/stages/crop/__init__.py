"""image, mask or box -> square crop, background removed."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.spec import Variant


class Cropper(Variant, Protocol):
    """What a crop variant is. ``size``: side S of the crop in pixels. The same protocol serves template and query."""

    size: int

    def __call__(
        self,
        rgb: UInt8[np.ndarray, "H W 3"],
        mask: Bool[np.ndarray, "H W"] | None,
        bbox_xyxy: tuple[float, float, float, float],
    ) -> tuple[UInt8[np.ndarray, "S S 3"], Bool[np.ndarray, "S S"], Float[np.ndarray, "3 3"]]:
        """rgb, mask and A_crop_img; without a mask the box's area is the mask. Raises NoPose for an empty mask."""
        ...
