"""Your own meshes, photograph, camera and optionally a mask or box -> a dataset of one image."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Bool, Float, Float32

from pipeline.bop.given import (
    GivenObjects,
    MeshFiles,
    check_box,
    check_box_in_image,
    check_own_camera,
    detect_box,
    detect_mask,
    parse_K,
)
from pipeline.bop.images import (
    QUARTER_TURNS,
    image_digest,
    image_size,
    read_depth,
    read_mask,
    read_orientation,
    read_rgb,
)
from pipeline.bop.lens import Lens, parse_lens
from pipeline.bop.scene import Box, xyxy_from_xywh
from pipeline.errors import BadInput
from pipeline.items.views import Detection, Image, Target
from pipeline.spec import FaceCount, Positive, PositiveFloat, Spec, digest, spec

SCENE_ID, IM_ID = 0, 0


@spec
class PhotoConfig(Spec):
    """A mesh, a photograph, K, and the object's location: a mask, a box, or neither if a detector is to find it.

    ``mesh``: one file, or several for a detector; they become objects 1, 2, ... in this order. ``K``: fx, fy, cx, cy
    or the nine numbers of the matrix, row by row. ``bbox``: x, y, width, height in pixels. ``mask_label``: the
    object's value in a mask that labels several. ``scale`` multiplies the mesh's vertices: 1000 for a mesh in metres.
    ``distortion``: k1, k2, p1, p2[, k3[, k4, k5, k6]] of OpenCV's model; the photograph, the mask and the box are
    undistorted before anything else.
    ``simplify``: most faces of a mesh, None for all. ``depth``: depth image of the photograph's size, ``depth_scale``
    mm per unit.
    """

    kind: ClassVar[str] = "dataset.photo"

    mesh: str | tuple[str, ...]
    image: str
    K: tuple[Any, ...]
    mask: str | None = None
    mask_label: Positive | None = None
    bbox: tuple[float, ...] | None = None
    scale: PositiveFloat = 1.0
    distortion: tuple[Any, ...] | str | None = None
    simplify: FaceCount | None = None
    depth: str | None = None
    depth_scale: PositiveFloat = 1.0
    name: str = "photo"

    def open(self) -> Photo:
        """The dataset, checked. Raises BadInput."""
        image = Path(self.image).expanduser()
        size_hw = image_size(image)
        K = parse_K(self.K, "dataset.K")
        check_own_camera(K, size_hw, "dataset.K")
        if self.mask is not None and self.bbox is not None:
            raise BadInput("dataset", found="mask and bbox", needed="only one of them")
        meshes = (self.mesh,) if isinstance(self.mesh, str) else self.mesh
        if not meshes or (len(meshes) > 1 and (self.mask or self.bbox)):
            found = f"{len(meshes)} meshes" + (" and the location of one object" if meshes else "")
            raise BadInput(
                "dataset.mesh", found=found, needed="one mesh, or several without dataset.mask and dataset.bbox"
            )
        if self.bbox is not None:
            check_box(self.bbox, "dataset.bbox")
        if self.depth is not None:
            self._check_depth(Path(self.depth).expanduser(), size_hw)
        return Photo(
            name=self.name,
            root=image.parent,
            split="test",
            models="",
            models_info={},
            targets=tuple(Target(SCENE_ID, IM_ID, obj_id) for obj_id in range(1, len(meshes) + 1)),
            photo_path=image,
            meshes=MeshFiles(tuple(Path(mesh).expanduser() for mesh in meshes), self.scale, self.simplify),
            camera_matrix=K,
            mask_label=self.mask_label,
            mask_file=None if self.mask is None else Path(self.mask).expanduser(),
            bbox_xyxy=None if self.bbox is None else xyxy_from_xywh(self.bbox),
            lens=None if self.distortion is None else parse_lens(self.distortion, K, size_hw),
            simplify=self.simplify,
            depth_file=None if self.depth is None else Path(self.depth).expanduser(),
            depth_scale=self.depth_scale,
        )

    def _check_depth(self, path: Path, size_hw: tuple[int, int]) -> None:
        """Raise BadInput for a depth image of another size, and for one of a photograph with distortion."""
        (h, w), found = size_hw, image_size(path)
        if found != size_hw:
            needed = f"those of the photograph, {w} x {h} (width x height): register depth to colour first"
            raise BadInput(path, found=f"{found[1]} x {found[0]} pixels", needed=needed)
        if self.distortion is not None:
            raise BadInput("dataset.depth", found="with dataset.distortion", needed="an undistorted pair of images")


@dataclass(frozen=True, eq=False)
class Photo(GivenObjects):
    """A dataset of one image, without ground truth."""

    photo_path: Path = Path()
    camera_matrix: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    mask_file: Path | None = None
    mask_label: int | None = None
    bbox_xyxy: Box | None = None
    lens: Lens | None = None
    depth_file: Path | None = None
    depth_scale: float = 1.0

    @property
    def gives_depth(self) -> bool:
        """Whether the configuration names a depth image."""
        return self.depth_file is not None

    def depth_path(self, scene_id: int, im_id: int) -> Path:
        """The depth image's file. Raises BadInput without one."""
        if self.depth_file is None:
            raise BadInput("dataset.depth", found="nothing", needed="a depth image, or depth=given")
        return self.depth_file

    def depth_mm(self, scene_id: int, im_id: int) -> Float32[np.ndarray, "H W"]:
        """Measured depth along the optical axis, mm; 0 where unknown."""
        return read_depth(self.depth_path(scene_id, im_id), self.depth_scale)

    def depth_identity(self, scene_id: int, im_id: int) -> str:
        """Digest of the measured depth."""
        return digest([image_digest(self.depth_path(scene_id, im_id), photograph=False), self.depth_scale])

    @property
    def location_field(self) -> str:
        """``dataset.mask`` or ``dataset.bbox``, "" without either."""
        return "dataset.mask" if self.mask_file else "dataset.bbox" if self.bbox_xyxy else ""

    @property
    def given_bbox_xyxy(self) -> Box | None:
        """The box, if one is given instead of a mask."""
        return self.bbox_xyxy

    @property
    def given_location(self) -> list[Any]:
        """Label of the mask and lens, where they are given."""
        given = [] if self.mask_label is None else [self.mask_label]
        return given if self.lens is None else [*given, self.lens.identity()]

    @property
    def image_note(self) -> str:
        """That pictures show the photograph without distortion."""
        return "" if self.lens is None else "undistorted photograph"

    def image(self, scene_id: int, im_id: int) -> Image:
        """The photograph, without the lens's distortion if that is given."""
        rgb = read_rgb(self.photo_path)
        return Image(scene_id, im_id, rgb if self.lens is None else self.lens.undistort(rgb), self.camera_matrix)

    def image_digest(self, scene_id: int, im_id: int) -> str:
        """Digest of the photograph as ``image`` returns it."""
        content = image_digest(self.photo_path)
        return content if self.lens is None else digest([content, self.lens.identity()])

    def object_mask(self, path: Path, size_hw: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
        """The mask in a file, without the lens's distortion if that is given. Raises BadInput for another size."""
        mask, (h, w) = read_mask(path, label=self.mask_label), size_hw
        if mask.shape != size_hw:
            turned = mask.shape == (w, h) and read_orientation(self.photo_path) in QUARTER_TURNS
            found = f"{mask.shape[1]} x {mask.shape[0]} pixels"
            cause = "; EXIF turns the photograph upright, and not the mask" if turned else ""
            raise BadInput(path, found=found, needed=f"those of the photograph, {w} x {h} (width x height){cause}")
        return mask if self.lens is None else self.lens.undistort(mask)

    def image_name(self, scene_id: int, im_id: int) -> str:
        """Name of the photograph's file."""
        return self.photo_path.name

    def image_path(self, scene_id: int, im_id: int) -> Path:
        """The photograph's file."""
        return self.photo_path

    def K(self, scene_id: int, im_id: int) -> Float[np.ndarray, "3 3"]:
        """The photograph's camera matrix, px."""
        return self.camera_matrix

    @property
    def location_files(self) -> list[Path]:
        """The photograph, and its mask file if given."""
        return [self.photo_path] + ([] if self.mask_file is None else [self.mask_file])

    def locate(self, target: Target) -> list[Detection]:
        """The detection of the mask or box. Raises BadInput for one that does not fit the photograph, and for none."""
        if self.mask_file is None and self.bbox_xyxy is None:
            needed = "dataset.mask=FILE or dataset.bbox=[x,y,w,h], or detect=cnos, which finds the object"
            raise BadInput("dataset", found="neither of mask and bbox", needed=needed)
        size_hw = self.image_size(target.scene_id, target.im_id)
        if self.mask_file is not None:
            return [detect_mask(target, self.object_mask(self.mask_file, size_hw), self.mask_file)]
        box = self.bbox_xyxy or (0.0,) * 4
        check_box_in_image(box, size_hw, "dataset.bbox")
        return [detect_box(target, box if self.lens is None else self.lens.undistort_box(box, "dataset.bbox"))]
