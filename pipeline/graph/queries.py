"""image, detections -> query crops -> query features, once per image; and queries, read back from these entries."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial

import numpy as np

from pipeline.bop.masks import decode_rle
from pipeline.errors import BadInput, NoPose
from pipeline.functional.rigid import nearest_rotation, rigid
from pipeline.graph.context import Context, ImageId, stack_crops
from pipeline.graph.describe import describe_mask
from pipeline.graph.detections import DetectionNodes
from pipeline.graph.tasks import Advance, Task
from pipeline.graph.timings import timing_key
from pipeline.items.features import CropFeatures
from pipeline.items.online import Query
from pipeline.items.views import Crop, Crops, Detection, Geometry
from pipeline.spec import digest
from pipeline.stages.render.raycast import DEPTH_VERSION, render_depth
from pipeline.store import Ref, make_ref


@dataclass(frozen=True)
class CroppedDetection:
    """A detection that has a crop: its index among all detections, and its row in the crops entry of its image."""

    index: int
    row: int
    detection: Detection


@dataclass(eq=False)
class QueryNodes:
    """Nodes of images. Methods named by a noun return references to entries; ``make_*`` compute missing entries."""

    context: Context
    detecting: DetectionNodes

    @property
    def detections(self) -> list[Detection]:
        """Detections of the targets, computed once."""
        return self.detecting.all

    @cached_property
    def of_target(self) -> dict[tuple[int, int, int], list[tuple[int, Detection]]]:
        """Detections by (scene_id, im_id, obj_id) with their index among all; includes defective ones."""
        grouped: dict[tuple[int, int, int], list[tuple[int, Detection]]] = {}
        for index, d in enumerate(self.detections):
            grouped.setdefault((d.scene_id, d.im_id, d.obj_id), []).append((index, d))
        return grouped

    @cached_property
    def of_image(self) -> dict[ImageId, list[tuple[int, Detection]]]:
        """Detections of each image without a defect, with their index, in order."""
        grouped: dict[ImageId, list[tuple[int, Detection]]] = {image: [] for image in self.context.image_ids}
        for index, detection in enumerate(self.detections):
            if detection.defect is None:
                grouped[detection.scene_id, detection.im_id].append((index, detection))
        return grouped

    @cached_property
    def crops(self) -> Callable[[ImageId], Ref]:
        """Crops of an image's detections."""
        return lru_cache(maxsize=None)(self._crops)

    def _crops(self, image: ImageId) -> Ref:
        shown = [[d.obj_id, list(d.bbox_xyxy), d.rle] for _, d in self.of_image[image]]
        recipe = {"kind": "query crops", "crop": self.context.stages.crop.recipe()}
        inputs = {"image": self.context.dataset.image_digest(*image), "detections": digest(shown)}
        if self.context.stages.crop.needs_camera:
            inputs["camera"] = digest(self.context.K(image).tolist())
        return make_ref("crops", recipe, inputs)

    def features(self, image: ImageId, layer: int) -> Ref:
        """Features of an image's detections, one layer."""
        inputs = {"crops": self.crops(image).key}
        if self.context.stages.extract.needs_geometry:
            poses = [
                [d.obj_id, self.context.mesh_digest(d.obj_id), self.true_pose(d).tolist()]
                for _, d in self.of_image[image]
            ]
            version = [] if DEPTH_VERSION == 1 else [DEPTH_VERSION]
            inputs["geometry"] = digest([poses, self.context.K(image).tolist(), *version])
        return self.context.features(layer, inputs)

    @cached_property
    def describe_task(self) -> Task[ImageId]:
        """Crops and features of an image's detections, by image."""
        return Task("query features", self._make_image, self._has_image)

    def _has_image(self, image: ImageId) -> bool:
        complete = self.context.store.is_complete
        if not complete(self.crops(image)):
            return False
        layers = self.context.stages.layers
        return not self.found(image) or all(complete(self.features(image, layer)) for layer in layers)

    def _make_image(self, image: ImageId, advance: Advance) -> None:
        self.make_features(image, self.make_crops(image))
        advance(1)

    def make_crops(self, image: ImageId) -> list[CroppedDetection]:
        """Crop an image's detections; the entry records why a detection has no crop."""
        ref = self.crops(image)
        if self.context.store.is_complete(ref):
            self.context.progress.add("query crops", reused=self.context.store.read(ref).rows)
            return self.found(image)
        began = time.perf_counter()
        crops, document = self._crop_detections(image)
        if not crops:
            self.context.store.put_document(ref, document, rows=0)
            return []
        arrays = stack_crops(crops)

        def compute(rows: list[int]) -> dict[str, dict[str, np.ndarray]]:
            return {ref.key: {name: values[rows] for name, values in arrays.items()}}

        self.context.fill(
            "query crops", "", {ref: self.context.crops_layout()}, len(crops), len(crops), compute, document
        )
        self.context.timings.add(
            timing_key("query crops", self.context.stages), len(crops), time.perf_counter() - began
        )
        return self.found(image)

    def _crop_detections(self, image: ImageId) -> tuple[list[Crop], dict[str, object]]:
        """Crops, and a document with the index of their detections and the reasons why others failed."""
        usable = self.of_image[image]
        photo = self.context.dataset.image(*image)
        crop, crops, kept, failed = self.context.stages.crop, list[Crop](), list[int](), dict[str, str]()
        for position, (_, detection) in enumerate(usable):
            try:
                mask = None if detection.rle is None else crop.clean_query(decode_rle(detection.rle))
                crops.append(crop(photo.rgb, mask, detection.bbox_xyxy, photo.K))
                kept.append(position)
            except NoPose as failure:
                failed[str(position)] = failure.reason
        return crops, {"kept": kept, "failed": failed}

    def found(self, image: ImageId) -> list[CroppedDetection]:
        """The detections of an image that have a crop."""
        usable = self.of_image[image]
        kept = self.context.store.read(self.crops(image)).document["kept"]
        return [CroppedDetection(usable[position][0], row, usable[position][1]) for row, position in enumerate(kept)]

    def make_features(self, image: ImageId, found: Sequence[CroppedDetection]) -> None:
        """Extract the missing features of an image's detections."""
        if found:
            refs = {layer: self.features(image, layer) for layer in self.context.stages.layers}
            self.context.extract(
                "query features", "", refs, len(found), lambda rows: self._crops_of(image, found, rows)
            )

    def _crops_of(self, image: ImageId, found: Sequence[CroppedDetection], rows: Sequence[int]) -> Crops:
        entry = self.context.store.read(self.crops(image))
        geometry = None
        if self.context.stages.extract.needs_geometry:
            photo = self.context.dataset.image(*image)
            poses = [self.true_pose(found[row].detection) for row in rows]
            depth = [
                render_depth(
                    self.context.model(found[row].detection.obj_id).mesh, photo.K, T[None], photo.rgb.shape[:2]
                )[0]
                for row, T in zip(rows, poses, strict=True)
            ]
            geometry = Geometry(depth, np.repeat(photo.K[None], len(rows), 0), np.stack(poses))
        return Crops(entry.array("rgb", rows), entry.array("mask", rows), entry.array("A_crop_img", rows), geometry)

    def true_pose(self, detection: Detection, *, asked_by: str = "extract=coordinates") -> np.ndarray:
        """T_cam_obj (mm) of a detection's ground-truth instance, for oracles. Raises BadInput where it has none."""
        if detection.gt_id is None:
            raise BadInput(
                asked_by,
                found="detections without ground truth",
                needed="detect=gt_mask or detect=gt_bbox",
            )
        T = self.context.dataset.ground_truth(detection.scene_id, detection.im_id)[detection.gt_id].T_cam_obj
        return rigid(nearest_rotation(T[:3, :3]), T[:3, 3])  # published rotations are rounded, rays need exact ones

    def query(self, found: CroppedDetection) -> tuple[Query, dict[str, float]]:
        """A detection as input of the online route, and its share of the seconds spent on its image."""
        image = (found.detection.scene_id, found.detection.im_id)
        entries = {layer: self.context.store.read(self.features(image, layer)) for layer in self.context.stages.layers}
        crops = self.context.store.read(self.crops(image))
        maps = {layer: self.context.tensor(entry.array("maps", [found.row])[0]) for layer, entry in entries.items()}
        mask, A_crop_img = crops.array("mask", [found.row])[0], crops.array("A_crop_img", [found.row])[0]
        share = {
            "crop": crops.time_s / crops.rows,
            "extract": max(entry.time_s for entry in entries.values()) / crops.rows,
        }
        crop = CropFeatures(maps, self.context.tensor(mask))
        others = partial(self._guess_again, found.detection) if self._can_guess(found.detection) else None
        return Query(crop, A_crop_img, self.context.K(image), others=others), share

    def _can_guess(self, detection: Detection) -> bool:
        """Whether to guess further masks of a detection: it had only a box, and the extractor is no oracle."""
        stages = self.context.stages
        boxed = detection.guessed or detection.rle is None
        return boxed and stages.segments and not stages.extract.needs_geometry and not stages.oracle

    def _guess_again(self, detection: Detection) -> Iterator[Query]:
        """The detection with further guesses at its mask, each cropped and encoded again."""
        stages = self.context.stages
        photo = self.context.dataset.image(detection.scene_id, detection.im_id)
        for mask in stages.segment.others(photo.rgb, detection.bbox_xyxy):
            try:
                yield describe_mask(self.context, photo, mask, detection.bbox_xyxy)
            except NoPose:
                continue

    def crop_failure(self, index: int, d: Detection) -> str:
        """Why a detection has no crop."""
        image = (d.scene_id, d.im_id)
        position = next(p for p, (i, _) in enumerate(self.of_image[image]) if i == index)
        return str(self.context.store.read(self.crops(image)).document["failed"][str(position)])
