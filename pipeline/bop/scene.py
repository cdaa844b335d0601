"""One scene's folder: cameras, ground truth and image files, each validated when it is first needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.bop.jsonio import abbreviate, describe_place, get_field, get_integer, get_numbers, is_number, read_by_id
from pipeline.bop.lens import describe_distortion
from pipeline.errors import BadInput
from pipeline.functional.rigid import rigid
from pipeline.io.digests import file_exists

# Largest entry of |R R^T - I|. LM-O's published rotations reach 1e-2; rounding to three decimals gives 2e-3.
ROTATION_TOLERANCE = 2e-2
_IMAGE_FILES = (("rgb", ".png"), ("rgb", ".jpg"), ("gray", ".png"), ("gray", ".tif"), ("gray", ".jpg"))
_DEPTH_FILES = (("depth", ".png"), ("depth", ".tif"))

Box = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Camera:
    """An image's camera matrix, px. ``depth_scale``: mm per unit of the depth image, None if unknown.

    ``distortion``: warning about distortion stated next to K, "" for none; images are assumed to be undistorted.
    """

    K: Float[np.ndarray, "3 3"]
    depth_scale: float | None
    distortion: str = ""


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """An annotated instance. ``gt_id``: its index in scene_gt.json. Rotations are kept as published.

    Boxes (x0, y0, x1, y1) are edges in pixels, of the visible part and of the full silhouette. They and ``visib_fract``
    are None without scene_gt_info.json; a box is also None for an instance outside the image.
    """

    gt_id: int
    obj_id: int
    T_cam_obj: Float[np.ndarray, "4 4"]
    visib_fract: float | None = None
    bbox_visib_xyxy: Box | None = None
    bbox_obj_xyxy: Box | None = None


@dataclass(frozen=True, eq=False)
class Scene:
    """A folder ``<root>/<split>/<scene_id>``. Its JSON files are read once, when first needed.

    ``sensor``: which sensor's files to read in a scene of several: scene_camera_cam1.json, rgb_cam1/.
    """

    folder: Path
    scene_id: int
    sensor: str = ""

    def path(self, name: str) -> Path:
        """A file or folder by its BOP name, such as scene_gt.json or mask, with the sensor's suffix if there is one."""
        stem, dot, suffix = name.partition(".")
        return self.folder / (f"{stem}_{self.sensor}{dot}{suffix}" if self.sensor else name)

    @cached_property
    def cameras(self) -> dict[int, Any]:
        """scene_camera.json by image, not validated."""
        return read_by_id(self.path("scene_camera.json"))

    @cached_property
    def annotations(self) -> dict[int, Any]:
        """scene_gt.json by image, not validated."""
        return read_by_id(self.path("scene_gt.json"))

    @cached_property
    def annotation_infos(self) -> dict[int, Any]:
        """scene_gt_info.json by image, not validated; empty without the file."""
        path = self.path("scene_gt_info.json")
        return read_by_id(path) if file_exists(path) else {}

    def image_path(self, im_id: int) -> Path:
        """The image's file: rgb/ is preferred to gray/, png to jpg and tif. Raises BadInput."""
        return self._find_file(_IMAGE_FILES, im_id, "an image")

    def depth_path(self, im_id: int) -> Path:
        """The depth image's file. Raises BadInput."""
        return self._find_file(_DEPTH_FILES, im_id, "a depth image")

    def mask_path(self, im_id: int, gt_id: int, *, visible: bool) -> Path:
        """File of an instance's mask, visible part or full silhouette. The file may be missing."""
        return self.path("mask_visib" if visible else "mask") / f"{im_id:06d}_{gt_id:06d}.png"

    def camera(self, im_id: int) -> Camera:
        """K and depth scale of one image. Raises BadInput."""
        path = self.path("scene_camera.json")
        where = describe_place(path, scene=self.scene_id, image=im_id)
        if im_id not in self.cameras:
            raise BadInput(where, found="no entry", needed="cam_K of this image")
        record = self.cameras[im_id]
        scale = record.get("depth_scale") if isinstance(record, dict) else None
        if scale is not None and not (is_number(scale) and np.isfinite(scale) and scale > 0):
            raise BadInput(f"{where}, field depth_scale", found=abbreviate(scale), needed="a number > 0")
        if isinstance(record, dict) and "cam_K" not in record and "cam_model" in record:
            found = f"cam_model {abbreviate(record['cam_model'])} and no cam_K"
            raise BadInput(where, found=found, needed="cam_K of a pinhole camera: undistort the images first")
        K = get_numbers(record, "cam_K", 9, where).reshape(3, 3)
        return Camera(K, None if scale is None else float(scale), describe_distortion(record))

    def ground_truth(self, im_id: int) -> list[GroundTruth]:
        """Annotated instances of one image. Raises BadInput for a missing annotation or an impossible pose."""
        if im_id not in self._ground_truth:
            self._ground_truth[im_id] = self._parse_ground_truth(im_id)
        return list(self._ground_truth[im_id])

    @cached_property
    def _ground_truth(self) -> dict[int, list[GroundTruth]]:
        """Cache of parsed instances by image, which every step needs. A plain dict, so that workers can unpickle it."""
        return {}

    def _parse_ground_truth(self, im_id: int) -> list[GroundTruth]:
        path = self.path("scene_gt.json")
        where = describe_place(path, scene=self.scene_id, image=im_id)
        records = self.annotations.get(im_id)
        if not isinstance(records, list):
            found = "no entry" if records is None else abbreviate(records)
            raise BadInput(where, found=found, needed="the list of annotated instances")
        infos = self._get_infos(im_id, len(records))
        pairs = enumerate(zip(records, infos, strict=True))
        return [_parse_instance(record, info, gt_id, f"{where}, instance {gt_id}") for gt_id, (record, info) in pairs]

    def _get_infos(self, im_id: int, count: int) -> list[Any]:
        """The image's entries of scene_gt_info.json; ``count`` times None without the file. Raises BadInput."""
        if not self.annotation_infos:
            return [None] * count
        infos = self.annotation_infos.get(im_id)
        if not isinstance(infos, list) or len(infos) != count:
            where = describe_place(self.path("scene_gt_info.json"), scene=self.scene_id, image=im_id)
            found = f"{len(infos)} entries" if isinstance(infos, list) else abbreviate(infos)
            found = "no entry" if infos is None else found
            raise BadInput(where, found=found, needed=f"{count} entries, as many as scene_gt.json has")
        return infos

    def _find_file(self, places: tuple[tuple[str, str], ...], im_id: int, what: str) -> Path:
        candidates = [self.path(folder) / f"{im_id:06d}{suffix}" for folder, suffix in places]
        for path in candidates:
            if file_exists(path):
                return path
        where = describe_place(self.folder, scene=self.scene_id, image=im_id)
        names = ", ".join(path.relative_to(self.folder).as_posix() for path in candidates)
        raise BadInput(where, found="no file", needed=f"{what} at one of {names}")


def xyxy_from_xywh(bbox_xywh: Sequence[float]) -> Box:
    """Edges (x0, y0, x1, y1) of BOP's box (x, y, w, h), which covers the pixel columns x to x + w - 1."""
    x, y, w, h = bbox_xywh
    return x - 0.5, y - 0.5, x + w - 0.5, y + h - 0.5


def describe_rotation_fault(R: Float[np.ndarray, "3 3"]) -> str:
    """Why R is not a rotation within ROTATION_TOLERANCE; "" if it is one."""
    error = float(np.abs(R @ R.T - np.eye(3)).max())
    if error > ROTATION_TOLERANCE:
        return f"a matrix whose R R^T differs from the identity by {error:.3g}"
    return "" if np.linalg.det(R) > 0 else "a reflection (determinant -1)"


def check_K(K: Float[np.ndarray, "3 3"], size_hw: tuple[int, int], where: str) -> None:
    """Raise BadInput for a K that is implausible for a pinhole camera with an image of this size.

    The principal point may lie outside the image, as in cropped images, but not so far that the whole image is more
    than 45 degrees off the optical axis. A field of view above 157 or below 0.6 degrees means that K has other units.
    """
    h, w = size_hw
    (fx, skew, cx), (zero, fy, cy) = K[:2]
    if np.abs(K[2] - [0, 0, 1]).max() > 1e-6 or abs(zero) > 1e-6:
        raise BadInput(where, found=f"rows {K[1].tolist()}, {K[2].tolist()}", needed="K = [fx 0 cx; 0 fy cy; 0 0 1]")
    if abs(skew) > 0.1:  # px of displacement at 45 degrees off the axis; the solvers ignore skew
        raise BadInput(where, found=f"a skew of {skew:g}", needed="a K without skew: undistort the images first")
    longer = max(h, w)
    if not (0.1 * longer < fx < 100 * longer and 0.1 * longer < fy < 100 * longer):
        needed = f"focal lengths in pixels of an image of {w} x {h} (width x height)"
        raise BadInput(where, found=f"fx {fx:g}, fy {fy:g}", needed=needed)
    if not (-fx <= cx <= w + fx and -fy <= cy <= h + fy):
        needed = f"a principal point in or near the image of {w} x {h} (width x height)"
        raise BadInput(where, found=f"cx {cx:g}, cy {cy:g}", needed=needed)


def _parse_instance(record: Any, info: Any, gt_id: int, where: str) -> GroundTruth:
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
    where = where.replace("/scene_gt", "/scene_gt_info")
    visible = get_field(info, "visib_fract", where)
    if not (is_number(visible) and 0 <= visible <= 1):
        raise BadInput(f"{where}, field visib_fract", found=abbreviate(visible), needed="a number from 0 to 1")
    return GroundTruth(
        gt_id, *pose, float(visible), _parse_box(info, "bbox_visib", where), _parse_box(info, "bbox_obj", where)
    )


def _parse_box(info: Any, field: str, where: str) -> Box | None:
    box = get_numbers(info, field, 4, where).tolist()
    is_visible = box[2] > 0 and box[3] > 0  # BOP writes -1 -1 -1 -1 for an instance outside the image
    return xyxy_from_xywh(box) if is_visible else None
