"""Views of objects: templates, images, targets, detections, proposals and square crops."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8


@dataclass(frozen=True, eq=False)
class Templates:
    """n rendered views of one object. Depth is along the optical axis, 0 for background; K in px, T_cam_obj in mm."""

    rgb: UInt8[np.ndarray, "n H W 3"]
    depth_mm: Float32[np.ndarray, "n H W"]
    mask: Bool[np.ndarray, "n H W"]
    K: Float[np.ndarray, "3 3"]
    T_cam_obj: Float[np.ndarray, "n 4 4"]


@dataclass(frozen=True, eq=False)
class Geometry:
    """True depth map, camera and pose of each view in a batch, for the oracle extractor ``extract=coordinates``."""

    depth_mm: Sequence[Float32[np.ndarray, "H W"]]
    K: Float[np.ndarray, "n 3 3"]
    T_cam_obj: Float[np.ndarray, "n 4 4"]


@dataclass(frozen=True, eq=False)
class Crop:
    """A square crop of a view, black outside ``mask``. The homography A_crop_img maps image to crop pixels."""

    rgb: UInt8[np.ndarray, "S S 3"]
    mask: Bool[np.ndarray, "S S"]
    A_crop_img: Float[np.ndarray, "3 3"]


@dataclass(frozen=True, eq=False)
class Crops:
    """Square crops of n views, black outside ``mask``. Each homography A_crop_img maps image to crop pixels."""

    rgb: UInt8[np.ndarray, "n S S 3"]
    mask: Bool[np.ndarray, "n S S"]
    A_crop_img: Float[np.ndarray, "n 3 3"]
    geometry: Geometry | None = None

    def __len__(self) -> int:
        return len(self.rgb)

    def __getitem__(self, rows: slice | Sequence[int]) -> Crops:
        """The selected crops, with their geometry."""
        take = list(range(len(self))[rows] if isinstance(rows, slice) else rows)
        geometry = self.geometry and Geometry(
            [self.geometry.depth_mm[i] for i in take], self.geometry.K[take], self.geometry.T_cam_obj[take]
        )
        return Crops(self.rgb[take], self.mask[take], self.A_crop_img[take], geometry)


@dataclass(frozen=True)
class Target:
    """A BOP target: estimate ``inst_count`` poses of object ``obj_id`` in image ``im_id`` of scene ``scene_id``."""

    scene_id: int
    im_id: int
    obj_id: int
    inst_count: int = 1


@dataclass(frozen=True)
class Detection:
    """An object detected in an image.

    ``bbox_xyxy``: edges in pixels; pixel i covers [i - 0.5, i + 0.5], so a mask of columns 3 to 5 spans 2.5 to 5.5.
    ``rle``: COCO compressed RLE of the mask in the full image ({"size": [h, w], "counts": str}), None for a box only.
    ``gt_id``: index in scene_gt.json of the instance, for detections made from ground truth. ``defect``: why it cannot
    be used, determined when it is read; such a detection becomes a NoEstimate. ``guessed``: its mask was made from its
    box.
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
    guessed: bool = False


@dataclass(frozen=True)
class Proposal:
    """A class-agnostic segment of an image that may be an object; box and mask as in Detection.

    ``confidence``: the mask's IoU as predicted by the model, about 0..1 (SAM's values may slightly exceed this range).
    """

    bbox_xyxy: tuple[float, float, float, float]
    rle: dict[str, Any]
    confidence: float


@dataclass(frozen=True, eq=False)
class Image:
    """An 8-bit rgb image with its camera matrix (px); a grey image has three equal channels."""

    scene_id: int
    im_id: int
    rgb: UInt8[np.ndarray, "H W 3"]
    K: Float[np.ndarray, "3 3"]
