"""image, mask or box, K -> what a camera that is turned towards the object would see, background removed."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8
from pydantic import Field

from pipeline.errors import NoPose
from pipeline.functional.camera import virtual_crop
from pipeline.functional.resample import warp
from pipeline.items.views import Crop
from pipeline.spec import Positive, Spec, spec
from pipeline.stages.crop import HALF, BBox, format_box, locate_object


@spec
class Virtual(Spec):
    """The picture of a virtual pinhole camera (Örnek et al., "FoundPose", ECCV 2024, section 3.2).

    Its optical axis goes through the centre of the mask's box, or of the given box where there is no mask; its focal
    length lets the square around the box just fit, whose side is ``padding_ratio`` times the box's longer side. An
    object at the image's border then looks as a template does, whose camera looks straight at it. Departures from the
    released code: the axis goes through the box's centre, there through the mean of the rays to its corners; there 1.2
    is the padding of a sphere through the corners, which is 1.2 sqrt(2) = 1.697 here. ``background``: ``remove``
    blackens what the mask leaves out before warping; ``keep`` leaves it. Outside the image the crop is black and no
    mask.
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
        both = warp(np.dstack([shown, area]), A_crop_img, size=self.size)
        return Crop(np.rint(both[..., :3]).clip(0, 255).astype(np.uint8), both[..., 3] >= HALF, A_crop_img)
