"""Your own meshes, photographs, camera and optionally masks or a box -> a dataset of one or several images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Bool, Float, Float32

from pipeline.bop.camera_files import NEEDED, CameraFile, estimate_camera, numbers_in, read_camera
from pipeline.bop.given import (
    GivenObjects,
    MeshFiles,
    Unit,
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

SCENE_ID = 0
EXIF_WARNING = (
    "K is a guess from the EXIF focal length, often 5 to 10 % off, and so is the distance: calibrate the camera"
)


@spec
class PhotoConfig(Spec):
    """Meshes, photographs, K, and the object's location: masks, a box, or neither if a detector finds it.

    ``mesh``: one file, or several for a detector; they become objects 1, 2, ... in this order. ``image``: a file, a
    pattern such as shots/*.png, or several files; photographs of one camera and size. ``K``: fx, fy, cx, cy, the nine
    numbers of the matrix row by row, a camera file, or "exif". ``mask``: a file, a pattern or several; with several
    photographs, a mask's name begins with that of its photograph. Each mask of a photograph is one instance.
    ``mask_label``: the value of the object, or values of its instances, in a mask of several labels. ``bbox``: x, y,
    width, height in pixels. ``scale`` multiplies the mesh's vertices, whose unit is ``units``. ``distortion``: k1, k2,
    p1, p2[, k3[, k4, k5, k6]] of OpenCV's model; photographs, masks and the box are undistorted before anything else.
    ``simplify``: maximum number of faces of a mesh, None for all. ``depth``: depth image of the photograph's size;
    ``depth_scale``: mm per unit. ``video``: the photographs are frames, sorted by name; each pose starts from the one
    before.
    """

    kind: ClassVar[str] = "dataset.photo"

    mesh: str | tuple[str, ...]
    image: str | tuple[str, ...]
    K: Any
    mask: str | tuple[str, ...] | None = None
    mask_label: Positive | tuple[Positive, ...] | None = None
    bbox: Any = None
    scale: PositiveFloat = 1.0
    units: Unit = "mm"
    distortion: Any = None
    simplify: FaceCount | None = None
    depth: str | None = None
    depth_scale: PositiveFloat = 1.0
    video: bool = False
    name: str = "photo"

    def open(self) -> Photo:
        """The dataset, checked. Raises BadInput."""
        photos = find_files(self.image, "dataset.image")
        size_hw = _common_size(photos)
        camera = self._camera(photos[0], size_hw)
        check_own_camera(camera.K, size_hw, "dataset.K")
        masks, bbox = self._locations(photos)
        meshes = (self.mesh,) if isinstance(self.mesh, str) else self.mesh
        if not meshes or (len(meshes) > 1 and (self.mask or self.bbox)):
            found = f"{len(meshes)} meshes" + (" and the location of one object" if meshes else "")
            raise BadInput(
                "dataset.mesh", found=found, needed="one mesh, or several without dataset.mask and dataset.bbox"
            )
        distortion = camera.distortion if self.distortion is None and camera.distortion else self.distortion
        if self.depth is not None:
            self._check_depth(Path(self.depth).expanduser(), len(photos), size_hw, distorted=distortion is not None)
        labels = len(self.mask_label) if isinstance(self.mask_label, tuple) else 1
        counts = [max(1, len(found)) * labels for found in masks] or [1] * len(photos)
        objects = range(1, len(meshes) + 1)
        return Photo(
            name=self.name,
            root=photos[0].parent,
            split="test",
            models="",
            models_info={},
            targets=tuple(Target(SCENE_ID, n, obj_id, count) for n, count in enumerate(counts) for obj_id in objects),
            warnings=(EXIF_WARNING,) if self.K == "exif" else (),
            photos=photos,
            meshes=MeshFiles(
                tuple(Path(mesh).expanduser() for mesh in meshes), self.scale, self.simplify, units=self.units
            ),
            camera_matrix=camera.K,
            mask_label=self.mask_label,
            masks=masks,
            bbox_xyxy=bbox,
            lens=None if distortion is None else parse_lens(distortion, camera.K, size_hw),
            simplify=self.simplify,
            depth_file=None if self.depth is None else Path(self.depth).expanduser(),
            depth_scale=self.depth_scale,
            is_video=self.video,
        )

    def _camera(self, photo: Path, size_hw: tuple[int, int]) -> CameraFile:
        """K, with distortion and image size if the camera file has them. Raises BadInput."""
        given = self.K
        if isinstance(given, str) and (numbers := numbers_in(given)) is not None:
            given = tuple(numbers)
        if isinstance(given, tuple):
            return CameraFile(parse_K(given, "dataset.K"))
        if given == "exif":
            return estimate_camera(photo, size_hw)
        if not isinstance(given, str):
            raise BadInput("dataset.K", found=repr(given), needed=NEEDED)
        path = Path(given).expanduser()
        if path.suffix.lower() not in (".yaml", ".yml", ".json"):
            raise BadInput("dataset.K", found=repr(given), needed=NEEDED)
        camera = read_camera(path)
        camera.check_size(size_hw, str(path))
        return camera

    def _locations(self, photos: tuple[Path, ...]) -> tuple[tuple[tuple[Path, ...], ...], Box | None]:
        """The masks of every photograph, and the box. Raises BadInput."""
        if self.mask is not None and self.bbox is not None:
            raise BadInput("dataset", found="mask and bbox", needed="only one of them")
        if self.bbox is not None:
            numbers = numbers_in(self.bbox) if isinstance(self.bbox, str) else self.bbox
            if not isinstance(numbers, (tuple, list)) or any(isinstance(n, (str, bool)) for n in numbers):
                raise BadInput("dataset.bbox", found=repr(self.bbox), needed="[x,y,width,height]")
            check_box(numbers, image_size(photos[0]), "dataset.bbox")
            if len(photos) > 1:
                found = f"one box for {len(photos)} photographs"
                raise BadInput("dataset.bbox", found=found, needed="dataset.mask, one for each photograph")
            return (), xyxy_from_xywh(numbers)
        return ((), None) if self.mask is None else (_pair_masks(find_files(self.mask, "dataset.mask"), photos), None)

    def _check_depth(self, path: Path, photos: int, size_hw: tuple[int, int], *, distorted: bool) -> None:
        """Raise BadInput for a depth image of another size, and for depth together with ``distortion``."""
        if photos > 1:
            raise BadInput("dataset.depth", found=f"one depth image for {photos} photographs", needed="one photograph")
        (h, w), found = size_hw, image_size(path)
        if found != size_hw:
            needed = f"those of the photograph, {w} x {h} (width x height): register depth to colour first"
            raise BadInput(path, found=f"{found[1]} x {found[0]} pixels", needed=needed)
        if distorted:
            where = "dataset.distortion" if self.distortion is not None else "a camera file that has distortion"
            raise BadInput("dataset.depth", found=f"with {where}", needed="an undistorted pair of images")


def find_files(given: str | tuple[str, ...], where: str) -> tuple[Path, ...]:
    """Files with this name or matching this pattern (* or ?), or several of these, sorted. Raises BadInput for none."""
    found: list[Path] = []
    for name in (given,) if isinstance(given, str) else given:
        path = Path(name).expanduser()
        if path.exists() or not set("*?") & set(name):
            found.append(path)
            continue
        anchor = Path(path.anchor)
        matching = sorted(match for match in anchor.glob(str(path.relative_to(anchor))) if match.is_file())
        if not matching:
            raise BadInput(where, found=f"no file that matches {name}", needed="at least one")
        found += matching
    if not found:
        raise BadInput(where, found="an empty list", needed="at least one file")
    return tuple(dict.fromkeys(found))


def _common_size(photos: tuple[Path, ...]) -> tuple[int, int]:
    """(h, w) of the photographs. Raises BadInput if they differ: one K cannot fit two sizes."""
    sizes = {path: image_size(path) for path in photos}
    first = sizes[photos[0]]
    for path, size_hw in sizes.items():
        if size_hw != first:
            needed = f"those of {photos[0].name}, {first[1]} x {first[0]} (width x height): one K belongs to one size"
            raise BadInput(path, found=f"{size_hw[1]} x {size_hw[0]} pixels", needed=needed)
    return first


def find_photograph(mask: Path, photos: Sequence[Path]) -> str | None:
    """The longest stem of a photograph that a mask's name has, alone or before ``_...``; None if there is none."""
    stems = [photo.stem for photo in photos if mask.stem == photo.stem or mask.stem.startswith(f"{photo.stem}_")]
    return max(stems, key=len, default=None)


def _pair_masks(masks: tuple[Path, ...], photos: tuple[Path, ...]) -> tuple[tuple[Path, ...], ...]:
    """The masks of every photograph: those whose names begin with its name. Raises BadInput."""
    if len(photos) == 1:
        return (masks,)
    owner = {mask: find_photograph(mask, photos) for mask in masks}
    paired = tuple(tuple(mask for mask in masks if owner[mask] == photo.stem) for photo in photos)
    for photo, own in zip(photos, paired, strict=True):
        if not own:
            found = f"no mask of {photo.name} among {len(masks)}"
            raise BadInput("dataset.mask", found=found, needed=f"one named {photo.stem}.png or {photo.stem}_*.png")
    return paired


@dataclass(frozen=True, eq=False)
class Photo(GivenObjects):
    """A dataset of photographs of one camera, without ground truth. ``masks``: of every photograph, or empty."""

    photos: tuple[Path, ...] = ()
    camera_matrix: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    masks: tuple[tuple[Path, ...], ...] = ()
    mask_label: int | tuple[int, ...] | None = None
    bbox_xyxy: Box | None = None
    lens: Lens | None = None
    depth_file: Path | None = None
    depth_scale: float = 1.0
    is_video: bool = False

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
        return "dataset.mask" if self.masks else "dataset.bbox" if self.bbox_xyxy else ""

    @property
    def given_bbox_xyxy(self) -> Box | None:
        """The box, if one is given instead of a mask."""
        return self.bbox_xyxy

    @property
    def given_location(self) -> list[Any]:
        """Label of the mask, and lens, if given."""
        given: list[Any] = [] if self.mask_label is None else [self.mask_label]
        return given if self.lens is None else [*given, self.lens.identity()]

    @property
    def image_note(self) -> str:
        """States that figures show the undistorted photograph, if they do."""
        return "" if self.lens is None else "undistorted photograph"

    def image(self, scene_id: int, im_id: int) -> Image:
        """The photograph, undistorted if the lens is known."""
        rgb = read_rgb(self.photos[im_id])
        return Image(scene_id, im_id, rgb if self.lens is None else self.lens.undistort(rgb), self.camera_matrix)

    def image_digest(self, scene_id: int, im_id: int) -> str:
        """Digest of the photograph as ``image`` returns it."""
        content = image_digest(self.photos[im_id])
        return content if self.lens is None else digest([content, self.lens.identity()])

    def object_mask(
        self, path: Path, size_hw: tuple[int, int], *, im_id: int = 0, label: int | None = None
    ) -> Bool[np.ndarray, "H W"]:
        """The mask in a file, undistorted if the lens is known. Raises BadInput for another size."""
        mask, (h, w) = read_mask(path, label=label), size_hw
        if mask.shape != size_hw:
            turned = mask.shape == (w, h) and read_orientation(self.photos[im_id]) in QUARTER_TURNS
            found = f"{mask.shape[1]} x {mask.shape[0]} pixels"
            cause = "; EXIF turns the photograph upright, and not the mask" if turned else ""
            raise BadInput(path, found=found, needed=f"those of the photograph, {w} x {h} (width x height){cause}")
        return mask if self.lens is None else self.lens.undistort(mask)

    def image_name(self, scene_id: int, im_id: int) -> str:
        """Name of the photograph's file."""
        return self.photos[im_id].name

    def image_path(self, scene_id: int, im_id: int) -> Path:
        """The photograph's file."""
        return self.photos[im_id]

    def K(self, scene_id: int, im_id: int) -> Float[np.ndarray, "3 3"]:
        """The photograph's camera matrix, px."""
        return self.camera_matrix

    @property
    def location_files(self) -> list[Path]:
        """The photographs, and their masks if given."""
        return [*self.photos, *(mask for masks in self.masks for mask in masks)]

    def locate(self, target: Target) -> list[Detection]:
        """Detections from the masks or the box. Raises BadInput if there are none, or if one does not fit."""
        if not self.masks and self.bbox_xyxy is None:
            needed = "dataset.mask=FILE or dataset.bbox=[x,y,w,h], or detect=search, which finds the object"
            raise BadInput("dataset", found="neither of mask and bbox", needed=needed)
        size_hw = self.image_size(target.scene_id, target.im_id)
        if self.masks:
            labels = self.mask_label if isinstance(self.mask_label, tuple) else (self.mask_label,)
            return [
                detect_mask(target, self.object_mask(path, size_hw, im_id=target.im_id, label=label), path)
                for path in self.masks[target.im_id]
                for label in labels
            ]
        box = self.bbox_xyxy or (0.0,) * 4
        check_box_in_image(box, size_hw, "dataset.bbox")
        return [detect_box(target, box if self.lens is None else self.lens.undistort_box(box, "dataset.bbox"))]
