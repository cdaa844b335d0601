"""One scene's folder: cameras, ground truth and the files of its images, each checked when it is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.bop.jsonio import abbreviate, describe_place, get_field, get_integer, get_numbers, is_number, read_by_id
from pipeline.errors import BadInput
from pipeline.functional.rigid import rigid

# LM-O publishes rotations that are orthonormal to 1e-2 only; results rounded to three decimals are off by 2e-3.
ROTATION_TOLERANCE = 2e-2
_IMAGE_FILES = ("rgb/{:06d}.png", "rgb/{:06d}.jpg", "gray/{:06d}.png", "gray/{:06d}.tif", "gray/{:06d}.jpg")
_DEPTH_FILES = ("depth/{:06d}.png", "depth/{:06d}.tif")

Box = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Camera:
    """A photograph's camera. ``depth_scale``: mm per unit of the depth image, None when the file does not say."""

    K: Float[np.ndarray, "3 3"]
    depth_scale: float | None


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """An annotated instance. ``gt_id``: its index in scene_gt.json; the rotation is kept as published.

    Boxes are edges in pixels (x0, y0, x1, y1), of the visible part and of the whole silhouette; they and
    ``visib_fract`` are None without scene_gt_info.json, and a box is None for an instance that is not in the image.
    """

    gt_id: int
    obj_id: int
    T_cam_obj: Float[np.ndarray, "4 4"]
    visib_fract: float | None = None
    bbox_visib_xyxy: Box | None = None
    bbox_obj_xyxy: Box | None = None


@dataclass(frozen=True, eq=False)
class Scene:
    """A folder ``<root>/<split>/<scene_id>``. Its JSON files are read once, when first needed."""

    folder: Path
    scene_id: int

    @cached_property
    def cameras(self) -> dict[int, Any]:
        """scene_camera.json by image, unchecked."""
        return read_by_id(self.folder / "scene_camera.json")

    @cached_property
    def annotations(self) -> dict[int, Any]:
        """scene_gt.json by image, unchecked."""
        return read_by_id(self.folder / "scene_gt.json")

    @cached_property
    def annotation_infos(self) -> dict[int, Any]:
        """scene_gt_info.json by image, unchecked; empty without the file."""
        path = self.folder / "scene_gt_info.json"
        return read_by_id(path) if path.exists() else {}

    def image_path(self, im_id: int) -> Path:
        """The photograph: rgb/ before gray/, png before jpg and tif."""
        return self._first(_IMAGE_FILES, im_id, "an image")

    def depth_path(self, im_id: int) -> Path:
        """The depth image."""
        return self._first(_DEPTH_FILES, im_id, "a depth image")

    def mask_path(self, im_id: int, gt_id: int, *, visible: bool) -> Path:
        """Mask of one annotated instance, its visible part or its whole silhouette. The file may be missing."""
        return self.folder / ("mask_visib" if visible else "mask") / f"{im_id:06d}_{gt_id:06d}.png"

    def camera(self, im_id: int) -> Camera:
        """K and depth scale of one image."""
        path = self.folder / "scene_camera.json"
        where = describe_place(path, scene=self.scene_id, image=im_id)
        if im_id not in self.cameras:
            raise BadInput(where, found="no entry", needed="cam_K of this image")
        record = self.cameras[im_id]
        scale = record.get("depth_scale") if isinstance(record, dict) else None
        if scale is not None and not (is_number(scale) and np.isfinite(scale) and scale > 0):
            raise BadInput(f"{where}, field depth_scale", found=abbreviate(scale), needed="a number > 0")
        K = get_numbers(record, "cam_K", 9, where).reshape(3, 3)
        return Camera(K, None if scale is None else float(scale))

    def ground_truth(self, im_id: int) -> list[GroundTruth]:
        """Annotated instances of one image. Raises BadInput when there is no annotation or a pose is impossible."""
        if im_id not in self._ground_truth:
            self._ground_truth[im_id] = self._parsed(im_id)
        return list(self._ground_truth[im_id])

    @cached_property
    def _ground_truth(self) -> dict[int, list[GroundTruth]]:
        """By image, parsed once: every step asks for it again. A dict, as a scene travels to workers."""
        return {}

    def _parsed(self, im_id: int) -> list[GroundTruth]:
        path = self.folder / "scene_gt.json"
        where = describe_place(path, scene=self.scene_id, image=im_id)
        records = self.annotations.get(im_id)
        if not isinstance(records, list):
            found = "no entry" if records is None else abbreviate(records)
            raise BadInput(where, found=found, needed="the list of annotated instances")
        infos = self._infos(im_id, len(records))
        pairs = enumerate(zip(records, infos, strict=True))
        return [_instance(record, info, gt_id, f"{where}, instance {gt_id}") for gt_id, (record, info) in pairs]

    def _infos(self, im_id: int, count: int) -> list[Any]:
        if not self.annotation_infos:
            return [None] * count
        infos = self.annotation_infos.get(im_id)
        if not isinstance(infos, list) or len(infos) != count:
            where = describe_place(self.folder / "scene_gt_info.json", scene=self.scene_id, image=im_id)
            found = (
                "no entry"
                if infos is None
                else f"{len(infos)} entries"
                if isinstance(infos, list)
                else abbreviate(infos)
            )
            raise BadInput(where, found=found, needed=f"{count} entries, as many as scene_gt.json has")
        return infos

    def _first(self, patterns: tuple[str, ...], im_id: int, what: str) -> Path:
        candidates = [self.folder / pattern.format(im_id) for pattern in patterns]
        for path in candidates:
            if path.exists():
                return path
        where = describe_place(self.folder, scene=self.scene_id, image=im_id)
        raise BadInput(
            where, found="no file", needed=f"{what} at one of {', '.join(p.format(im_id) for p in patterns)}"
        )


def xyxy_from_xywh(bbox_xywh: Sequence[float]) -> Box:
    """(x0, y0, x1, y1) of BOP's box (x, y, w, h), whose columns are x to x + w - 1."""
    x, y, w, h = bbox_xywh
    return x - 0.5, y - 0.5, x + w - 0.5, y + h - 0.5


def describe_rotation_fault(R: Float[np.ndarray, "3 3"]) -> str:
    """Why R is no rotation, "" when it is one within ROTATION_TOLERANCE."""
    off = float(np.abs(R @ R.T - np.eye(3)).max())
    if off > ROTATION_TOLERANCE:
        return f"a matrix whose R R^T is off the identity by {off:.3g}"
    return "" if np.linalg.det(R) > 0 else "a reflection (determinant -1)"


def check_K(K: Float[np.ndarray, "3 3"], size_hw: tuple[int, int], where: str) -> None:
    """Raise BadInput for a K that no pinhole camera with an image of this size can have.

    Cropped images are legitimate: their principal point may lie outside, but not so far that the whole image is more
    than 45 degrees off the optical axis. A field of view above 157 or below 0.6 degrees is a K in other units.
    """
    h, w = size_hw
    (fx, skew, cx), (zero, fy, cy) = K[:2]
    if np.abs(K[2] - [0, 0, 1]).max() > 1e-6 or abs(zero) > 1e-6:
        raise BadInput(where, found=f"rows {K[1].tolist()}, {K[2].tolist()}", needed="K = [fx 0 cx; 0 fy cy; 0 0 1]")
    if abs(skew) > 0.1:  # pixels at 45 degrees off the axis; the solvers ignore skew
        raise BadInput(where, found=f"a skew of {skew:g}", needed="a K without skew: undistort the images first")
    longer = max(h, w)
    if not (0.1 * longer < fx < 100 * longer and 0.1 * longer < fy < 100 * longer):
        needed = f"focal lengths in pixels of an image of {w} x {h} (width x height)"
        raise BadInput(where, found=f"fx {fx:g}, fy {fy:g}", needed=needed)
    if not (-fx <= cx <= w + fx and -fy <= cy <= h + fy):
        needed = f"a principal point in or near the image of {w} x {h} (width x height)"
        raise BadInput(where, found=f"cx {cx:g}, cy {cy:g}", needed=needed)


def _instance(record: Any, info: Any, gt_id: int, where: str) -> GroundTruth:
    R = get_numbers(record, "cam_R_m2c", 9, where).reshape(3, 3)
    t = get_numbers(record, "cam_t_m2c", 3, where)
    if fault := describe_rotation_fault(R):
        raise BadInput(f"{where}, field cam_R_m2c", found=fault, needed="a rotation matrix, row by row")
    if t[2] <= 0:
        raise BadInput(
            f"{where}, field cam_t_m2c", found=f"z = {t[2]:g}", needed="an object in front of the camera, mm"
        )
    pose = get_integer(record, "obj_id", where), rigid(R, t)
    if info is None:
        return GroundTruth(gt_id, *pose)
    where = where.replace("scene_gt.json", "scene_gt_info.json")
    visible = get_field(info, "visib_fract", where)
    if not (is_number(visible) and 0 <= visible <= 1):
        raise BadInput(f"{where}, field visib_fract", found=abbreviate(visible), needed="a number from 0 to 1")
    return GroundTruth(gt_id, *pose, float(visible), _box(info, "bbox_visib", where), _box(info, "bbox_obj", where))


def _box(info: Any, field: str, where: str) -> Box | None:
    box = get_numbers(info, field, 4, where).tolist()
    return (
        xyxy_from_xywh(box) if box[2] > 0 and box[3] > 0 else None
    )  # BOP writes -1 -1 -1 -1 for an instance not in sight
