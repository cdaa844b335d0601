"""User input instead of a dataset folder: meshes, images with cameras, and masks or boxes of the objects."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from pipeline.bop.dataset import Dataset
from pipeline.bop.masks import encode_rle
from pipeline.bop.scene import Box, check_K
from pipeline.errors import BadInput
from pipeline.functional.camera import mask_bbox
from pipeline.functional.camera_diagnosis import denormalize_camera
from pipeline.io.meshes import prepare_mesh, prepared_digest
from pipeline.items.objects import MeshFacts, ObjectModel
from pipeline.items.views import Detection, Target

MIN_DIAMETER_MM = 2.0
MAX_METRES = 3.0  # units=auto takes a smaller diameter as metres
Unit = Literal["mm", "cm", "m", "inch", "auto"]
_FACTORS: dict[str, float] = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}


@dataclass(frozen=True)
class MeshFiles:
    """Meshes of the objects 1, 2, ...; ``scale`` multiplies their vertices, ``simplify`` limits the faces of each.

    ``names``: of the objects, by default those of the files. ``units``: of the files; "auto" assumes metres, with a
    warning, for a diameter below 3, and millimetres otherwise.
    """

    paths: tuple[Path, ...] = ()
    scale: float = 1.0
    simplify: int | None = None
    names: tuple[str, ...] = ()
    units: Unit = "mm"

    def name(self, obj_id: int) -> str:
        """The user's name of an object."""
        return self.names[obj_id - 1] if self.names else self.path(obj_id).stem

    def path(self, obj_id: int) -> Path:
        """An object's file."""
        return self.paths[obj_id - 1]

    def digest(self, obj_id: int) -> str:
        """Digest of an object's mesh, scaled and simplified."""
        return prepared_digest(self.path(obj_id), scale=self.factor(obj_id), simplify=self.simplify)

    def model(self, obj_id: int) -> ObjectModel:
        """An object with its mesh scaled and simplified. Raises BadInput for a mesh too small to be in millimetres."""
        path = self.path(obj_id)
        factor = self.factor(obj_id)
        mesh, facts = prepare_mesh(path, scale=factor, simplify=self.simplify)
        if facts.diameter_mm < MIN_DIAMETER_MM:
            found = f"a mesh of diameter {facts.diameter_mm:.3g} (it looks like metres)"
            raise BadInput(path, found=found, needed="millimetres: dataset.scale=1000 converts from metres")
        return ObjectModel(obj_id, mesh, facts.diameter_mm, facts=facts)

    def unit_warning(self, obj_id: int, facts: MeshFacts) -> str:
        """That a mesh was taken as metres, "" otherwise. Templates do not state it: those of units=m are the same."""
        if self.units != "auto" or self.factor(obj_id) == self.scale:
            return ""
        return f"taken as metres (units=auto), which makes its diameter {facts.diameter_mm:.4g} mm"

    def factor(self, obj_id: int) -> float:
        """Millimetres per unit of an object's file."""
        if self.units != "auto":
            return self.scale * _FACTORS[self.units]
        path = self.path(obj_id)
        is_metres = self.scale * _diameter_in_file(path, prepared_digest(path)) < MAX_METRES
        return self.scale * (_FACTORS["m"] if is_metres else 1.0)


@lru_cache(maxsize=64)
def _diameter_in_file(path: Path, content: str) -> float:
    """The diameter of a mesh file, in the file's own unit. ``content``: its digest, part of the cache key."""
    return prepare_mesh(path)[1].diameter_mm


@dataclass(frozen=True, eq=False)
class GivenObjects(Dataset):
    """A dataset without ground truth, made of the user's meshes, images and cameras, and optionally masks or boxes."""

    meshes: MeshFiles = field(default_factory=MeshFiles)

    @abstractmethod
    def locate(self, target: Target) -> list[Detection]:
        """Detections of an object in an image, from the given masks or boxes. Raises BadInput if there are none."""

    @property
    def location_files(self) -> list[Path]:
        """Files that ``locate`` reads, including the photographs."""
        return []

    @property
    def requires_pose(self) -> bool:
        """True: a run that finds no pose is a failure."""
        return True

    @property
    def finds_symmetries(self) -> bool:
        """True: user meshes have no models_info.json that would list them."""
        return True

    def has_ground_truth(self, scene_id: int) -> bool:
        """False: there is no ground truth."""
        return False

    def object_name(self, obj_id: int) -> str:
        """As MeshFiles.name."""
        return self.meshes.name(obj_id)

    def distortion(self, scene_id: int, im_id: int) -> str:
        """Empty: images are already undistorted."""
        return ""

    def model_path(self, obj_id: int, *, folder: str | None = None) -> Path:
        """An object's mesh file."""
        return self.meshes.path(obj_id)

    def mesh_digest(self, obj_id: int) -> str:
        """As MeshFiles.digest."""
        return self.meshes.digest(obj_id)

    def model_warning(self, obj_id: int, facts: MeshFacts) -> str:
        """As MeshFiles.unit_warning, with the mesh's name."""
        warning = self.meshes.unit_warning(obj_id, facts)
        return warning and f"mesh of {self.object_name(obj_id)}: {warning}"

    def object_model(self, obj_id: int, *, folder: str | None = None) -> ObjectModel:
        """As MeshFiles.model."""
        return self.meshes.model(obj_id)


def parse_K(K: Sequence[Any], where: str) -> Float[np.ndarray, "3 3"]:
    """The camera matrix from [fx,fy,cx,cy], its nine numbers row by row, or its three rows. Raises BadInput."""
    flat = [value for row in K for value in (row if isinstance(row, (tuple, list)) else (row,))]
    if not all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in flat):
        raise BadInput(where, found=list(K), needed="numbers: [fx,fy,cx,cy] or the matrix, row by row")
    if len(flat) == 4:
        fx, fy, cx, cy = flat
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    if len(flat) == 9:
        return np.array(flat, float).reshape(3, 3)
    raise BadInput(where, found=f"{len(flat)} numbers", needed="[fx,fy,cx,cy] or the 9 of the matrix, row by row")


def check_own_camera(K: Float[np.ndarray, "3 3"], size_hw: tuple[int, int], where: str) -> None:
    """Raise BadInput for a K that cannot belong to the image; without ground truth, no later check would notice."""
    if pixels := denormalize_camera(K, size_hw):
        fx, fy, cx, cy = (float(v) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
        fitting = ",".join(f"{v:.6g}" for v in pixels)
        found = f"[{fx:g}, {fy:g}, {cx:g}, {cy:g}], divided by the image's size"
        raise BadInput(where, found=found, needed=f"pixels: '{where}=[{fitting}]'")
    check_K(K, size_hw, where)
    (h, w), (cx, cy) = size_hw, K[:2, 2]
    if not (-w <= cx <= 2 * w and -h <= cy <= 2 * h):
        found = f"principal point ({cx:g}, {cy:g}) for an image of {w} x {h} (width x height)"
        raise BadInput(where, found=found, needed="the K of this image at this size")


def check_box(bbox_xywh: Sequence[float], size_hw: tuple[int, int], where: str) -> None:
    """Raise BadInput unless a box is four finite numbers in pixels, with positive width and height."""
    if len(bbox_xywh) != 4:
        raise BadInput(where, found=f"{len(bbox_xywh)} numbers", needed="4: [x,y,width,height]")
    if not np.isfinite(bbox_xywh).all():
        raise BadInput(where, found=list(bbox_xywh), needed="four finite numbers: [x,y,width,height]")
    if min(bbox_xywh[2:]) <= 0:
        found = f"{list(bbox_xywh)}, which has no area"
        raise BadInput(where, found=found, needed="[x,y,width,height] with width and height above 0")
    if max(bbox_xywh) <= 1:
        fitting = ",".join(f"{v * size:.6g}" for v, size in zip(bbox_xywh, 2 * size_hw[::-1], strict=True))
        found = f"{list(bbox_xywh)}, fractions of the image"
        raise BadInput(where, found=found, needed=f"pixels: [{fitting}]")


def check_box_in_image(box: Box, size_hw: tuple[int, int], where: str) -> None:
    """Raise BadInput for a box that lies outside the image."""
    (x0, y0, x1, y1), (h, w) = box, size_hw
    if x1 <= x0 or y1 <= y0 or x1 <= -0.5 or y1 <= -0.5 or x0 >= w - 0.5 or y0 >= h - 0.5:
        needed = f"x, y, width, height of a box inside the image of {w} x {h}"
        raise BadInput(where, found=[x0 + 0.5, y0 + 0.5, x1 - x0, y1 - y0], needed=needed)


def detect_mask(target: Target, mask: Bool[np.ndarray, "H W"], where: object) -> Detection:
    """A detection with this mask and score 1. Raises BadInput if the mask is empty."""
    around = mask_bbox(mask)
    if around is None:
        raise BadInput(where, found="an empty mask", needed="the object's pixels not black")
    return Detection(target.scene_id, target.im_id, target.obj_id, 1.0, 0.0, around, encode_rle(mask))


def detect_box(target: Target, box: Box) -> Detection:
    """A detection with this box (x0, y0, x1, y1) and score 1."""
    return Detection(target.scene_id, target.im_id, target.obj_id, 1.0, 0.0, box)
