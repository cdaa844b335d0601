"""image, mask or box -> square crop around the object, background removed."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8
from pydantic import Field

from pipeline.errors import NoPose
from pipeline.functional.camera import mask_bbox, square_crop
from pipeline.functional.resample import resample
from pipeline.spec import Positive, Spec, spec

_HALF = 0.5 - 1e-5  # half covered in float32 still counts as half


@spec
class Square(Spec):
    """A square around the mask's box, or around the given box where there is no mask.

    ``padding_ratio``: side of the square over the box's longer side. ``background``: ``remove`` blackens what the mask
    leaves out before resampling, so that none of it bleeds into the crop; ``keep`` leaves it. Outside the image the
    crop is black and no mask; the square never moves.
    """

    kind: ClassVar[str] = "crop.square"
    version: ClassVar[int] = 1

    size: Positive = 128
    padding_ratio: Annotated[float, Field(ge=1, allow_inf_nan=False)] = 1.2
    background: Literal["remove", "keep"] = "remove"

    def __call__(
        self,
        rgb: UInt8[np.ndarray, "H W 3"],
        mask: Bool[np.ndarray, "H W"] | None,
        bbox_xyxy: tuple[float, float, float, float],
    ) -> tuple[UInt8[np.ndarray, "S S 3"], Bool[np.ndarray, "S S"], Float[np.ndarray, "3 3"]]:
        """rgb, mask (at least half of the pixel) and A_crop_img. With a mask, its own box counts, not the given one.

        Raises NoPose for an empty mask, one of another size than the image, and a box without a pixel of the image.
        """
        object_mask = _box_mask(bbox_xyxy, rgb.shape[:2]) if mask is None else mask
        if object_mask.shape != rgb.shape[:2]:
            raise NoPose("crop", f"mask is {_wide_high(object_mask)} px, image is {_wide_high(rgb)} px")
        box = bbox_xyxy if mask is None else mask_bbox(object_mask)
        if box is None:
            raise NoPose("crop", "mask is empty, needs 1 pixel")
        A_crop_img = square_crop(box, size=self.size, padding_ratio=self.padding_ratio)
        shown = rgb * object_mask[..., None] if self.background == "remove" else rgb
        crop = np.rint(resample(shown, A_crop_img, size=self.size)).clip(0, 255).astype(np.uint8)
        return crop, resample(object_mask, A_crop_img, size=self.size) >= _HALF, A_crop_img


def _box_mask(bbox_xyxy: tuple[float, float, float, float], size_hw: tuple[int, ...]) -> Bool[np.ndarray, "H W"]:
    """Pixels whose centre is in the box. Raises NoPose when there is none."""
    x0, y0, x1, y1 = bbox_xyxy
    if not (np.isfinite(bbox_xyxy).all() and x1 > x0 and y1 > y0):
        raise NoPose("crop", f"box {_text(bbox_xyxy)} has no area")
    x, y = np.arange(size_hw[1]), np.arange(size_hw[0])
    inside = ((y >= y0) & (y <= y1))[:, None] & ((x >= x0) & (x <= x1))
    if not inside.any():
        raise NoPose("crop", f"box {_text(bbox_xyxy)} holds no pixel of the {size_hw[1]} x {size_hw[0]} image")
    return inside


def _text(bbox_xyxy: tuple[float, float, float, float]) -> str:
    return "({:g}, {:g}, {:g}, {:g})".format(*bbox_xyxy)


def _wide_high(image: np.ndarray) -> str:
    return f"{image.shape[1]} x {image.shape[0]}"
