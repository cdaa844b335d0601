"""What a camera sees: templates, detections, targets and the square crops made of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8


@dataclass(frozen=True, eq=False)
class Templates:
    """Rendered views of one object. Pixel centres are integers; depth is along the optical axis, 0 = background."""

    rgb: UInt8[np.ndarray, "n H W 3"]
    depth_mm: Float32[np.ndarray, "n H W"]
    mask: Bool[np.ndarray, "n H W"]
    K: Float[np.ndarray, "3 3"]
    T_cam_obj: Float[np.ndarray, "n 4 4"]


@dataclass(frozen=True, eq=False)
class Geometry:
    """What the oracle knows of each view of a batch: depth map, camera and pose (for ``extract=coordinates``)."""

    depth_mm: Sequence[Float32[np.ndarray, "H W"]]
    K: Float[np.ndarray, "n 3 3"]
    T_cam_obj: Float[np.ndarray, "n 4 4"]


@dataclass(frozen=True, eq=False)
class Crop:
    """One square crop of a view: black outside ``mask``; the homography A_crop_img takes image to crop pixels."""

    rgb: UInt8[np.ndarray, "S S 3"]
    mask: Bool[np.ndarray, "S S"]
    A_crop_img: Float[np.ndarray, "3 3"]


@dataclass(frozen=True, eq=False)
class Crops:
    """Square crops of n views: background removed (black) outside ``mask``; A_crop_img takes image to crop pixels."""

    rgb: UInt8[np.ndarray, "n S S 3"]
    mask: Bool[np.ndarray, "n S S"]
    A_crop_img: Float[np.ndarray, "n 3 3"]
    geometry: Geometry | None = None

    def __len__(self) -> int:
        return len(self.rgb)

    def __getitem__(self, rows: slice | Sequence[int]) -> Crops:
        """The crops of some rows, geometry included."""
        index = range(len(self))[rows] if isinstance(rows, slice) else list(rows)
        take = list(index)
        geometry = self.geometry and Geometry(
            [self.geometry.depth_mm[i] for i in take], self.geometry.K[take], self.geometry.T_cam_obj[take]
        )
        return Crops(self.rgb[take], self.mask[take], self.A_crop_img[take], geometry)


@dataclass(frozen=True)
class Target:
    """What BOP asks: ``inst_count`` poses of object ``obj_id`` in image ``im_id`` of scene ``scene_id``."""

    scene_id: int
    im_id: int
    obj_id: int
    inst_count: int = 1


@dataclass(frozen=True)
class Detection:
    """One object found in one image.

    ``bbox_xyxy``: edges in pixels, pixel i covers [i - 0.5, i + 0.5], so a mask from column 3 to 5 spans 2.5 to 5.5.
    ``rle``: COCO compressed RLE of the full-image mask ({"size": [h, w], "counts": str}), or None for a box alone.
    ``gt_id``: index in scene_gt of the instance it was made from, when it was made from ground truth.
    ``defect``: why it cannot be used, found when it was read; such a detection becomes a NoEstimate.
    """

    scene_id: int
    im_id: int
    obj_id: int
    score: float
    time_s: float
    bbox_xyxy: tuple[float, float, float, float]
    rle: dict[str, Any] | None = None
    gt_id: int | None = None
    defect: str | None = None


@dataclass(frozen=True)
class Proposal:
    """A part of an image that may be an object, of whatever class; box and mask as in Detection.

    ``confidence``: the IoU its model predicts of the mask, about 0..1 (SAM's may leave that range a little).
    """

    bbox_xyxy: tuple[float, float, float, float]
    rle: dict[str, Any]
    confidence: float


@dataclass(frozen=True, eq=False)
class Image:
    """A photograph with its camera. ``rgb`` is 8 bit; a grey image has three equal channels."""

    scene_id: int
    im_id: int
    rgb: UInt8[np.ndarray, "H W 3"]
    K: Float[np.ndarray, "3 3"]
