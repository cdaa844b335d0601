"""BOP folder -> targets, images, cameras, ground truth, object models."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32

from pipeline.bop.images import (
    count_frames,
    image_digest,
    image_size,
    read_depth,
    read_mask,
    read_orientation,
    read_rgb,
)
from pipeline.bop.jsonio import describe_place, read_json
from pipeline.bop.layout import check_folders, check_scene_folder, check_sensor_name, find_model
from pipeline.bop.lens import describe_distortion
from pipeline.bop.models import ModelInfo, check_model_files, compare_diameters, read_model, read_models_info
from pipeline.bop.projection import check_projections
from pipeline.bop.scene import Box, GroundTruth, Scene, check_K
from pipeline.bop.targets import count_instances, names_images_only, parse_images, parse_targets
from pipeline.errors import BadInput
from pipeline.io.digests import file_exists
from pipeline.io.meshes import prepared_digest
from pipeline.items.objects import MeshFacts, ObjectModel
from pipeline.items.views import Image, Target
from pipeline.spec import FaceCount, digest, spec

BOP_WIDTH_PX = {"lm": 640, "lmo": 640, "ycbv": 640, "tless": 720, "tudl": 640, "icbin": 640, "hb": 640, "itodd": 1280}
"""Widths of BOP's test images, used when scoring without the images."""


@spec
class DatasetConfig:
    """Name and location of a dataset. Keys depend on the contents of its files, not on ``root``.

    ``sensor``: which sensor's files to read, in datasets whose scenes were recorded by several.
    ``simplify``: maximum number of faces of a mesh; None keeps all.
    """

    name: str
    root: str
    split: str = "test"
    models: str = "models"
    targets: str | None = "test_targets_bop19.json"
    sensor: str | None = None
    simplify: FaceCount | None = None

    def open(self) -> Dataset:
        """The dataset, checked. Raises BadInput."""
        root, sensor = Path(self.root).expanduser(), self.sensor
        data = open_dataset(
            root, name=self.name, split=self.split, models=self.models, targets=self.targets, sensor=sensor
        )
        return replace(data, simplify=self.simplify)


@dataclass(frozen=True, eq=False)
class Dataset:
    """A BOP dataset whose targets have images, cameras and models. Pixels and meshes are read on demand.

    ``targets`` are sorted by scene, image and object; ``models_info`` is empty without models_info.json. ``warnings``:
    results of sanity checks when it was opened. ``simplify``: maximum number of faces of the meshes that templates are
    rendered from (None: all faces); scores use the full meshes. Unusable input raises BadInput, one line that names the
    file, scene, image and field.
    """

    name: str
    root: Path
    split: str
    models: str
    models_info: dict[int, ModelInfo]
    targets: tuple[Target, ...] = ()
    warnings: tuple[str, ...] = ()
    sensor: str = ""
    simplify: int | None = None
    _scenes: dict[int, Scene] = field(default_factory=dict, repr=False)

    @property
    def object_ids(self) -> tuple[int, ...]:
        """Ids of the targets' objects, sorted."""
        return tuple(sorted({target.obj_id for target in self.targets}))

    @property
    def images(self) -> tuple[tuple[int, int], ...]:
        """(scene_id, im_id) of the targets' images, sorted."""
        return tuple(sorted({(target.scene_id, target.im_id) for target in self.targets}))

    @property
    def location_field(self) -> str:
        """The config field that gives the object's location, such as ``dataset.mask``; "" without one."""
        return ""

    @property
    def given_bbox_xyxy(self) -> Box | None:
        """A box from the config instead of a file; it is part of the keys of detections."""
        return None

    @property
    def given_location(self) -> list[Any]:
        """What else the config says about where objects are; it is part of the keys of detections."""
        return []

    @property
    def requires_pose(self) -> bool:
        """Whether a run that finds no pose at all counts as failed."""
        return False

    @property
    def gives_depth(self) -> bool:
        """Whether the user gave a depth image; poses are then fitted to it."""
        return False

    @property
    def is_video(self) -> bool:
        """Whether the images are frames in order, so that the pose in one is expected to be near that in the next."""
        return False

    def prior(self, obj_id: int, detection_id: int) -> Float[np.ndarray, "4 4"] | None:
        """The pose T_cam_obj (mm) that the user expects of a detection; None where nothing is known."""
        return None

    @property
    def finds_symmetries(self) -> bool:
        """Whether symmetries have to be detected on the meshes because no file lists them."""
        return False

    @property
    def image_note(self) -> str:
        """How images were changed after reading, for figure captions; "" if they were not."""
        return ""

    def image_name(self, scene_id: int, im_id: int) -> str:
        """Name of an image in messages."""
        return f"scene {scene_id}, image {im_id}"

    def object_name(self, obj_id: int) -> str:
        """Name of an object in messages."""
        return f"object {obj_id}"

    def scene(self, scene_id: int) -> Scene:
        """The scene; its JSON files are read once."""
        if scene_id not in self._scenes:
            folder = self.root / self.split / f"{scene_id:06d}"
            check_scene_folder(folder, scene_id, self.sensor)
            self._scenes[scene_id] = Scene(folder, scene_id, self.sensor)
        return self._scenes[scene_id]

    def image(self, scene_id: int, im_id: int) -> Image:
        """The image, 8-bit rgb, with its K."""
        rgb = read_rgb(self.image_path(scene_id, im_id))
        K = self.K(scene_id, im_id)
        check_K(K, (rgb.shape[0], rgb.shape[1]), self.where_camera(scene_id, im_id))
        return Image(scene_id, im_id, rgb, K)

    def image_path(self, scene_id: int, im_id: int) -> Path:
        """The image's file."""
        return self.scene(scene_id).image_path(im_id)

    def image_digest(self, scene_id: int, im_id: int) -> str:
        """Digest of the image as ``image`` returns it."""
        return image_digest(self.image_path(scene_id, im_id))

    def image_size(self, scene_id: int, im_id: int) -> tuple[int, int]:
        """(h, w) of the image, from its header."""
        return image_size(self.image_path(scene_id, im_id))

    def orientation(self, scene_id: int, im_id: int) -> int:
        """EXIF orientation of the image's file, 1 for an upright one."""
        return read_orientation(self.image_path(scene_id, im_id))

    def count_frames(self, scene_id: int, im_id: int) -> int:
        """Frames of the image's file, of which the first is read."""
        return count_frames(self.image_path(scene_id, im_id))

    def image_width(self, scene_id: int, im_id: int) -> int:
        """Width of the image, px: from its file, its depth image, camera*.json or BOP_WIDTH_PX, in this order.

        Raises BadInput if none of them has it.
        """
        for find_file in (self.image_path, self.depth_path):
            try:
                return image_size(find_file(scene_id, im_id))[1]
            except BadInput:
                continue
        for record in self._root_cameras():
            width = record.get("width")
            if isinstance(width, int) and width > 0:
                return width
        if self.name in BOP_WIDTH_PX:
            return BOP_WIDTH_PX[self.name]
        where = describe_place(self.scene(scene_id).folder, scene=scene_id, image=im_id)
        raise BadInput(where, found="neither an image nor a depth image", needed="one of them, for its width")

    def K(self, scene_id: int, im_id: int) -> Float[np.ndarray, "3 3"]:
        """The image's camera matrix, px."""
        return self.scene(scene_id).camera(im_id).K

    def distortion(self, scene_id: int, im_id: int) -> str:
        """Warning about distortion stated in the camera's record or camera*.json, which is not applied; "" for none."""
        return self.scene(scene_id).camera(im_id).distortion or self._root_distortion

    def _root_cameras(self) -> list[dict[str, Any]]:
        """Contents of the dataset's camera*.json files; of one file only if a sensor is chosen and has its own."""
        own = self.root / f"camera_{self.sensor}.json"
        paths = [own] if self.sensor and file_exists(own) else sorted(self.root.glob("camera*.json"))
        contents = [read_json(path) for path in paths]
        return [content for content in contents if isinstance(content, dict)]

    @cached_property
    def _root_distortion(self) -> str:
        """Warning about distortion from the only camera*.json; "" if there are several, one per sensor."""
        with suppress(BadInput):  # nothing else needs this file
            records = self._root_cameras()
            return describe_distortion(records[0]) if len(records) == 1 else ""
        return ""

    def depth_path(self, scene_id: int, im_id: int) -> Path:
        """The depth image's file."""
        return self.scene(scene_id).depth_path(im_id)

    def depth_mm(self, scene_id: int, im_id: int) -> Float32[np.ndarray, "H W"]:
        """Measured depth along the optical axis, mm; 0 where unknown."""
        scale = self.scene(scene_id).camera(im_id).depth_scale
        if scale is None:
            where = describe_place(self.scene(scene_id).path("scene_camera.json"), scene=scene_id, image=im_id)
            raise BadInput(f"{where}, field depth_scale", found="nothing", needed="mm per unit of the depth image")
        return read_depth(self.depth_path(scene_id, im_id), scale)

    def depth_identity(self, scene_id: int, im_id: int) -> str:
        """Digest of the measured depth. Raises BadInput where there is no depth image."""
        content = image_digest(self.depth_path(scene_id, im_id), photograph=False)
        return digest([content, self.scene(scene_id).camera(im_id).depth_scale])

    def has_ground_truth(self, scene_id: int) -> bool:
        """Whether the scene is annotated."""
        return file_exists(self.scene(scene_id).path("scene_gt.json"))

    def ground_truth(self, scene_id: int, im_id: int) -> list[GroundTruth]:
        """Annotated instances in the order of scene_gt.json (index = gt_id), rotations as published."""
        return self.scene(scene_id).ground_truth(im_id)

    def mask_path(self, scene_id: int, im_id: int, gt_id: int, *, visible: bool = True) -> Path:
        """File of an instance's mask, visible part or full silhouette. The file may be missing."""
        return self.scene(scene_id).mask_path(im_id, gt_id, visible=visible)

    def mask(self, scene_id: int, im_id: int, gt_id: int, *, visible: bool = True) -> Bool[np.ndarray, "H W"]:
        """An instance's mask, visible part or full silhouette."""
        return read_mask(self.mask_path(scene_id, im_id, gt_id, visible=visible))

    def model_path(self, obj_id: int, *, folder: str | None = None) -> Path:
        """The object's mesh file, in ``folder`` (None: the dataset's models)."""
        return find_model(self.root / (folder or self.models), obj_id)

    def object_model(self, obj_id: int, *, folder: str | None = None) -> ObjectModel:
        """Mesh, diameter and symmetries, from ``folder`` (None: the dataset's models; "models_eval" for metrics).

        Only the dataset's models are simplified.
        """
        path = self.model_path(obj_id, folder=folder)
        infos = read_models_info(path.parent / "models_info.json") if folder else self.models_info
        simplify = None if folder else self.simplify
        return read_model(path, obj_id, infos, distances_mm=self._distances_mm(obj_id), simplify=simplify)

    def model_warning(self, obj_id: int, facts: MeshFacts) -> str:
        """Where models_info.json contradicts the mesh; "" if it does not."""
        info = self.models_info.get(obj_id)
        return "" if info is None else compare_diameters(self.model_path(obj_id), facts, info)

    def mesh_digest(self, obj_id: int) -> str:
        """``object_model(obj_id).mesh.digest``, without parsing the mesh where its format allows."""
        return prepared_digest(self.model_path(obj_id), simplify=self.simplify)

    def _distances_mm(self, obj_id: int) -> list[float]:
        images = {(t.scene_id, t.im_id) for t in self.targets if t.obj_id == obj_id}
        annotated = [self.ground_truth(s, i) for s, i in sorted(images) if self.has_ground_truth(s)]
        return [float(np.linalg.norm(gt.T_cam_obj[:3, 3])) for gts in annotated for gt in gts if gt.obj_id == obj_id]

    def where_camera(self, scene_id: int, im_id: int) -> str:
        """Location of an image's K in its file, for error messages."""
        return describe_place(
            self.scene(scene_id).path("scene_camera.json"), scene=scene_id, image=im_id, field="cam_K"
        )


def open_dataset(
    root: Path,
    *,
    name: str,
    split: str = "test",
    models: str = "models",
    targets: str | None = "test_targets_bop19.json",
    sensor: str | None = None,
    photographs: bool = True,
) -> Dataset:
    """The dataset at ``root``, after checking that every target has an image, a camera and a model.

    ``photographs``: also check the images, which scoring does not need. ``models``: folder of the meshes (T-LESS:
    models_cad or models_reconst). ``targets``: file of the targets; with None or a missing file, every annotated
    instance of every image is a target. ``sensor``: see DatasetConfig. Reads only JSON files and image headers. Raises
    BadInput at the first error.
    """
    check_folders(root, split, models)
    infos = read_models_info(root / models / "models_info.json")
    dataset = Dataset(name, root, split, models, infos, sensor=check_sensor_name(sensor))
    path = None if targets is None else root / targets
    records = None if path is None or not file_exists(path) else read_json(path)
    if path is None or records is None:
        dataset = replace(dataset, targets=_list_annotated_targets(dataset))
    elif names_images_only(records):
        dataset = _use_annotated_objects(dataset, path, records)
    else:
        dataset = replace(dataset, targets=parse_targets(path, records))
    for obj_id in dataset.object_ids:
        check_model_files(dataset.model_path(obj_id), obj_id, dataset.models_info)
    for scene_id, im_id in dataset.images if photographs else ():
        _check_image(dataset, scene_id, im_id)
    return dataset


def _use_annotated_objects(dataset: Dataset, path: Path, records: list[Any]) -> Dataset:
    """The dataset with every annotated instance of the images as a target, and a warning that says so."""
    images = sorted(parse_images(path, records))
    if missing := [scene_id for scene_id, _ in images if not dataset.has_ground_truth(scene_id)]:
        found = f"targets without obj_id (BOP24's detection tasks), and no annotations in scene {missing[0]}"
        raise BadInput(path, found=found, needed="scene_id, im_id, obj_id, inst_count: test_targets_bop19.json")
    targets = _require_targets(dataset, count_instances((dataset.scene(s), i) for s, i in images))
    warning = f"{path.name}: targets have no obj_id (BOP24's detection tasks); the annotated objects are the targets"
    return replace(dataset, targets=targets, warnings=(warning,))


def _list_annotated_targets(dataset: Dataset) -> tuple[Target, ...]:
    """Every annotated instance of every image."""
    split = dataset.root / dataset.split
    scene_ids = sorted(int(path.name) for path in split.iterdir() if path.is_dir() and path.name.isdigit())
    if scene_ids and not any(map(dataset.has_ground_truth, scene_ids)):
        found = "neither a targets file nor annotations (scene_gt.json), as in BOP's test sets"
        needed = f"dataset.targets, a file of {dataset.root} with scene_id, im_id, obj_id, inst_count"
        raise BadInput(split, found=found, needed=needed)
    scenes = map(dataset.scene, scene_ids)
    return _require_targets(dataset, count_instances((scene, i) for scene in scenes for i in scene.annotations))


def _require_targets(dataset: Dataset, targets: tuple[Target, ...]) -> tuple[Target, ...]:
    """The targets. Raises BadInput if there are none."""
    if not targets:
        split = dataset.root / dataset.split
        raise BadInput(split, found="no annotated image", needed="a targets file, or scenes with scene_gt.json")
    return targets


def _check_image(dataset: Dataset, scene_id: int, im_id: int) -> None:
    """Raise BadInput for a target's image that is missing or whose K belongs to another image size."""
    K, size_hw = dataset.K(scene_id, im_id), dataset.image_size(scene_id, im_id)
    where = dataset.where_camera(scene_id, im_id)
    check_K(K, size_hw, where)
    if dataset.has_ground_truth(scene_id):
        check_projections(dataset.ground_truth(scene_id, im_id), dataset.models_info, K, size_hw, where)
