"""image, mask or box -> square crop around the object with the background removed."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8
from pydantic import Field

from pipeline.functional.camera import square_crop
from pipeline.functional.resample import resample
from pipeline.items.views import Crop
from pipeline.spec import Positive, spec
from pipeline.stages.crop import HALF, BBox, Cropper, locate_object


@spec
class Square(Cropper):
    """A square around the mask's box, or around the given box where there is no mask.

    ``padding_ratio``: side of the square over the longer side of the box. ``background``: ``remove`` blackens pixels
    outside the mask before resampling, so that they do not bleed into the crop; ``keep`` leaves them. Outside the image
    the crop is black and not part of the mask; the square is not moved to fit into the image.
    """

    kind: ClassVar[str] = "crop.square"
    version: ClassVar[int] = 1

    size: Positive = 128
    padding_ratio: Annotated[float, Field(ge=1, allow_inf_nan=False)] = 1.2
    background: Literal["remove", "keep"] = "remove"

    def __call__(
        self,
        rgb: UInt8[np.ndarray, "H W 3"],
        mask: Bool[np.ndarray, "h w"] | None,
        bbox_xyxy: BBox,
        K: Float[np.ndarray, "3 3"],
    ) -> Crop:
        """A_crop_img is a scale and a shift; K is not used. Raises NoPose as ``locate_object`` does."""
        area, box = locate_object(mask, bbox_xyxy, (rgb.shape[0], rgb.shape[1]))
        A_crop_img = square_crop(box, size=self.size, padding_ratio=self.padding_ratio)
        shown = rgb * area[..., None] if self.background == "remove" else rgb
        crop = np.rint(resample(shown, A_crop_img, size=self.size)).clip(0, 255).astype(np.uint8)
        return Crop(crop, resample(area, A_crop_img, size=self.size) >= HALF, A_crop_img)
