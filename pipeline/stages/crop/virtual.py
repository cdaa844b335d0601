"""image, mask or box, K -> the view of a virtual camera that is turned towards the object, background removed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8
from pydantic import Field

from pipeline.errors import NoPose
from pipeline.functional.camera import virtual_crop
from pipeline.functional.masks import erode, open_mask
from pipeline.functional.resample import warp
from pipeline.items.views import Crop
from pipeline.spec import NonNegative, Positive, spec
from pipeline.stages.crop import HALF, BBox, Cropper, format_box, locate_object


@spec
class Virtual(Cropper):
    """The image of a virtual pinhole camera (Örnek et al., "FoundPose", ECCV 2024, section 3.2).

    Its optical axis goes through the centre of the mask's box, or of the given box where there is no mask. Its focal
    length makes the square around the box, with a side of ``padding_ratio`` times the box's longer side, just fit. An
    object at the image's border is then seen straight on, as in a template.

    ``background``: ``remove`` blackens pixels outside the mask before warping; ``keep`` leaves them. Outside the image
    the crop is black and not part of the mask.

    ``erode_template``: pixels of the crop that a template's mask loses at its contour, where depth is least exact; a
    mask that would lose all its pixels stays as it is. ``open_query``: a detection's mask keeps only what squares of
    2 ``open_query`` + 1 image pixels cover, which drops specks; the box is that of what is left. FoundPose's code
    erodes by 5 x 5 and opens by 3 x 3 pixels. 0: off.

    Differences to the released code: its axis goes through the mean of the rays to the box's corners, and its padding
    of 1.2 refers to a sphere through the corners, which is 1.2 sqrt(2) = 1.697 here.
    """

    kind: ClassVar[str] = "crop.virtual"
    version: ClassVar[int] = 1
    added: ClassVar[Mapping[str, Any]] = {"erode_template": 0, "open_query": 0}
    needs_camera: ClassVar[bool] = True

    size: Positive = 128
    padding_ratio: Annotated[float, Field(ge=1, allow_inf_nan=False)] = 1.2
    background: Literal["remove", "keep"] = "remove"
    erode_template: NonNegative = 0
    open_query: NonNegative = 0

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

    def clean_query(self, mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
        """The opened mask. Raises NoPose for a mask of which nothing is left."""
        if not self.open_query or not mask.any():
            return mask
        opened = open_mask(mask, radius=self.open_query)
        if not opened.any():
            side = 2 * self.open_query + 1
            raise NoPose("crop", f"mask of {mask.sum()} px is too thin, crop.open_query needs {side} x {side} px")
        return opened

    def clean_template(self, mask: Bool[np.ndarray, "S S"]) -> Bool[np.ndarray, "S S"]:
        """The eroded mask, or the mask itself where nothing would be left of it."""
        eroded = erode(mask, radius=self.erode_template)
        return eroded if eroded.any() else mask
