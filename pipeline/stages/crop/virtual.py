"""image, mask or box, K -> the view of a virtual camera that is turned towards the object, background removed."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8
from pydantic import Field

from pipeline.errors import NoPose
from pipeline.functional.camera import virtual_crop
from pipeline.functional.resample import warp
from pipeline.items.views import Crop
from pipeline.spec import Positive, spec
from pipeline.stages.crop import HALF, BBox, Cropper, format_box, locate_object


@spec
class Virtual(Cropper):
    """The image of a virtual pinhole camera (Örnek et al., "FoundPose", ECCV 2024, section 3.2).

    Its optical axis goes through the centre of the mask's box, or of the given box where there is no mask. Its focal
    length makes the square around the box, with a side of ``padding_ratio`` times the box's longer side, just fit. An
    object at the image's border is then seen straight on, as in a template.

    ``background``: ``remove`` blackens pixels outside the mask before warping; ``keep`` leaves them. Outside the image
    the crop is black and not part of the mask.

    Differences to the released code: its axis goes through the mean of the rays to the box's corners, and its padding
    of 1.2 refers to a sphere through the corners, which is 1.2 sqrt(2) = 1.697 here.
    """

    kind: ClassVar[str] = "crop.virtual"
    version: ClassVar[int] = 1
    needs_camera: ClassVar[bool] = True

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
        """A_crop_img is the homography K_virtual R K^-1.

        Raises NoPose as ``locate_object`` does, and for a box that reaches a right angle away from its centre.
        """
        area, box = locate_object(mask, bbox_xyxy, (rgb.shape[0], rgb.shape[1]))
        try:
            A_crop_img = virtual_crop(box, K, size=self.size, padding_ratio=self.padding_ratio)
        except ValueError as reason:
            raise NoPose("crop", f"box {format_box(box)} with this K: {reason}") from None
        shown = rgb * area[..., None] if self.background == "remove" else rgb
        warped = warp(np.dstack([shown, area]), A_crop_img, size=self.size)
        return Crop(np.rint(warped[..., :3]).clip(0, 255).astype(np.uint8), warped[..., 3] >= HALF, A_crop_img)
