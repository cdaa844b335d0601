"""One image in memory, its camera, and masks or boxes of objects -> a dataset of one image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from pipeline.bop.given import GivenObjects, check_box, check_box_in_image, detect_box, detect_mask
from pipeline.bop.pixels import select_object
from pipeline.bop.scene import Box, xyxy_from_xywh
from pipeline.errors import BadInput
from pipeline.items.views import Detection, Image, Target
from pipeline.spec import digest

Location = Bool[np.ndarray, "H W"] | Box
"""A mask, or a box (x0, y0, x1, y1)."""


@dataclass(frozen=True, eq=False)
class Frame(GivenObjects):
    """A dataset of one image in memory. ``locations``: obj_id -> one mask or box per instance.

    ``priors``: obj_id -> the expected pose T_cam_obj (mm) of each instance, or None.
    """

    rgb: UInt8[np.ndarray, "H W 3"] = field(default_factory=lambda: np.zeros((0, 0, 3), np.uint8))
    camera_matrix: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    locations: Mapping[int, Sequence[Location]] = field(default_factory=dict)
    depth: Float32[np.ndarray, "H W"] | None = None
    priors: Mapping[int, Sequence[Float[np.ndarray, "4 4"] | None]] = field(default_factory=dict)

    def prior(self, obj_id: int, detection_id: int) -> Float[np.ndarray, "4 4"] | None:
        """The expected pose of an instance."""
        given = self.priors.get(obj_id, ())
        return given[detection_id] if detection_id < len(given) else None

    @property
    def gives_depth(self) -> bool:
        """Whether there is a depth image."""
        return self.depth is not None

    def depth_mm(self, scene_id: int, im_id: int) -> Float32[np.ndarray, "H W"]:
        """Measured depth along the optical axis, mm; 0 where unknown. Raises BadInput if none was given."""
        if self.depth is None:
            raise BadInput("depth_mm", found="nothing", needed="a depth image, or the setting depth=given")
        return self.depth

    def depth_identity(self, scene_id: int, im_id: int) -> str:
        """Digest of the measured depth."""
        return sha256(np.ascontiguousarray(self.depth_mm(scene_id, im_id)).data).hexdigest()

    def image(self, scene_id: int, im_id: int) -> Image:
        """The image."""
        return Image(scene_id, im_id, self.rgb, self.camera_matrix)

    def image_digest(self, scene_id: int, im_id: int) -> str:
        """Digest of the pixels."""
        return self._digest

    @cached_property
    def _digest(self) -> str:
        return digest([list(self.rgb.shape), sha256(np.ascontiguousarray(self.rgb).data).hexdigest()])

    def image_size(self, scene_id: int, im_id: int) -> tuple[int, int]:
        """(h, w) of the image."""
        h, w = self.rgb.shape[:2]
        return h, w

    def image_name(self, scene_id: int, im_id: int) -> str:
        """A fixed name: there is only one image."""
        return "image"

    def orientation(self, scene_id: int, im_id: int) -> int:
        """1: an array has no EXIF orientation."""
        return 1

    def count_frames(self, scene_id: int, im_id: int) -> int:
        """1: an array holds one frame."""
        return 1

    def K(self, scene_id: int, im_id: int) -> Float[np.ndarray, "3 3"]:
        """The camera matrix, px."""
        return self.camera_matrix

    @property
    def given_location(self) -> list[Any]:
        """Digest of the masks and boxes, in place of the digests of files."""
        masks_and_boxes = [[obj_id, *map(_identify, given)] for obj_id, given in sorted(self.locations.items())]
        return [digest(masks_and_boxes)]

    def locate(self, target: Target) -> list[Detection]:
        """A detection for every mask and box of the object, with score 1."""
        given = self.locations[target.obj_id]
        return [detect_box(target, at) if isinstance(at, tuple) else detect_mask(target, at, "mask") for at in given]


def parse_image(rgb: np.ndarray) -> UInt8[np.ndarray, "H W 3"]:
    """An image as h x w x 3, uint8; a grey image gets three equal channels. Raises BadInput."""
    image = np.asarray(rgb)
    if (
        image.dtype != np.uint8
        or not image.size
        or image.ndim not in (2, 3)
        or (image.ndim == 3 and image.shape[2] != 3)
    ):
        raise BadInput("rgb", found=f"{image.dtype} of shape {image.shape}", needed="uint8 of shape (h, w, 3), in RGB")
    return np.repeat(image[..., None], 3, axis=-1) if image.ndim == 2 else image


def parse_depth(depth_mm: np.ndarray, size_hw: tuple[int, int]) -> Float32[np.ndarray, "H W"]:
    """A depth image in mm; NaN and infinity become 0, unknown. Raises BadInput for another shape or negative values."""
    given = np.asarray(depth_mm)
    if given.dtype.kind not in "uif":
        raise BadInput("depth_mm", found=f"an array of {given.dtype}", needed="numbers of shape (h, w), in mm")
    depth = np.nan_to_num(given.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)
    if depth.shape != size_hw:
        needed = f"that of the image, {size_hw[0]} x {size_hw[1]} (rows x columns): register depth to colour first"
        raise BadInput("depth_mm", found=f"shape {depth.shape}", needed=needed)
    if depth.min(initial=0) < 0:
        raise BadInput("depth_mm", found="negative values", needed="millimetres along the optical axis, 0 for unknown")
    return depth


def parse_prior(given: Any, where: str = "prior") -> Float[np.ndarray, "4 4"]:
    """An expected pose T_cam_obj, mm. Raises BadInput for what is no rigid transform to a place before the camera."""
    try:
        T = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        T = np.zeros(0)
    needed = "T_cam_obj, 4 x 4 in mm, such as result.T_cam_obj"
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise BadInput(where, found=f"shape {T.shape}" if T.size else repr(given)[:60], needed=needed)
    if not np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-3) or np.linalg.det(T[:3, :3]) < 0:
        raise BadInput(where, found="a matrix that is no rotation", needed=needed)
    if T[2, 3] <= 0:
        raise BadInput(where, found=f"z {T[2, 3]:.4g} mm, behind the camera", needed=needed)
    return T


def parse_locations(given: Any, size_hw: tuple[int, int]) -> tuple[Location, ...]:
    """Masks and boxes of an object's instances, from one mask, one box [x,y,width,height], or a list of these.

    Raises BadInput for other input, and for a mask or box that does not fit the image.
    """
    if isinstance(given, (list, tuple)) and given and np.ndim(given[0]) > 0:
        return tuple(_parse_location(one, size_hw, f" of instance {n}") for n, one in enumerate(given))
    return (_parse_location(given, size_hw, ""),)


def _parse_location(given: Any, size_hw: tuple[int, int], instance: str) -> Location:
    values = np.asarray(given)
    if values.dtype.kind not in "buif":
        found = f"an array of {values.dtype} and shape {values.shape}"
        raise BadInput(
            f"mask, bbox{instance}", found=found, needed="a mask (h, w), or a box [x,y,width,height] in pixels"
        )
    if values.ndim == 1:
        numbers, where = [float(value) for value in values], f"bbox{instance}"
        check_box(numbers, size_hw, where)
        box = xyxy_from_xywh(numbers)
        check_box_in_image(box, size_hw, where)
        return box
    where = f"mask{instance}"
    if values.shape[:2] != size_hw:
        needed = f"that of the image, {size_hw[0]} x {size_hw[1]} (rows x columns), or a box [x,y,width,height]"
        raise BadInput(where, found=f"shape {values.shape}", needed=needed)
    mask = values if values.dtype == bool else select_object(values, Path(where))
    if not mask.any():
        raise BadInput(where, found="an empty mask", needed="the object's pixels not 0")
    return mask


def _identify(location: Location) -> list[float] | str:
    return list(location) if isinstance(location, tuple) else sha256(np.packbits(location).data).hexdigest()
