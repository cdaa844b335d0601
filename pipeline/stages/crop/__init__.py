"""image, mask or box, K -> square crop with the background removed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.errors import NoPose
from pipeline.functional.camera import mask_bbox
from pipeline.items.views import Crop
from pipeline.spec import Spec

HALF = 0.5 - 1e-5  # coverage of a mask's pixel; float32 may round one half down

BBox = tuple[float, float, float, float]


class Cropper(Spec, ABC):
    """Contract of a crop variant; templates and queries are cropped in the same way.

    A variant may clean masks on one side: ``clean_query`` before a detection is cropped, ``clean_template`` after a
    template is.

    ``size``: side S of the crop in pixels. ``needs_camera``: whether the crop depends on K, which then enters its key.
    """

    needs_camera: ClassVar[bool] = False
    size: int

    @abstractmethod
    def __call__(
        self,
        rgb: UInt8[np.ndarray, "H W 3"],
        mask: Bool[np.ndarray, "h w"] | None,
        bbox_xyxy: BBox,
        K: Float[np.ndarray, "3 3"],
    ) -> Crop:
        """The crop around the mask, or around the box where ``mask`` is None. Raises NoPose for an empty mask."""

    def clean_query(self, mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
        """A detection's mask, in image pixels, as it is to be cropped. Raises NoPose where nothing is left of it."""
        return mask

    def clean_template(self, mask: Bool[np.ndarray, "S S"]) -> Bool[np.ndarray, "S S"]:
        """A template's mask, in crop pixels, as later stages are to use it."""
        return mask


def locate_object(
    mask: Bool[np.ndarray, "h w"] | None, bbox_xyxy: BBox, size_hw: tuple[int, int]
) -> tuple[Bool[np.ndarray, "H W"], BBox]:
    """The object's pixels and their bounding box; with a mask, the given box is ignored.

    Raises NoPose for an empty mask, a mask of another size than the image, and a box that contains no pixel of it.
    """
    if mask is None:
        return _box_mask(bbox_xyxy, size_hw), bbox_xyxy
    if mask.shape != size_hw:
        raise NoPose("crop", f"mask is {_format_size(mask.shape)} px, image is {_format_size(size_hw)} px")
    box = mask_bbox(mask)
    if box is None:
        raise NoPose("crop", "mask is empty, needs 1 pixel")
    return mask, box


def _box_mask(bbox_xyxy: BBox, size_hw: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """Pixels whose centre is in the box. Raises NoPose if there are none."""
    x0, y0, x1, y1 = bbox_xyxy
    if not (np.isfinite(bbox_xyxy).all() and x1 > x0 and y1 > y0):
        raise NoPose("crop", f"box {format_box(bbox_xyxy)} has no area")
    x, y = np.arange(size_hw[1]), np.arange(size_hw[0])
    inside = ((y >= y0) & (y <= y1))[:, None] & ((x >= x0) & (x <= x1))
    if not inside.any():
        raise NoPose("crop", f"box {format_box(bbox_xyxy)} holds no pixel of the {size_hw[1]} x {size_hw[0]} image")
    return inside


def format_box(bbox_xyxy: BBox) -> str:
    """The box as text, for messages."""
    return "({:g}, {:g}, {:g}, {:g})".format(*bbox_xyxy)


def _format_size(size_hw: tuple[int, ...]) -> str:
    return f"{size_hw[1]} x {size_hw[0]}"
