"""detections file -> detections."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

from pipeline.bop.dataset import Dataset
from pipeline.bop.detection_checks import check_boxes_and_masks, check_ids
from pipeline.bop.detections import Entry, read_entries
from pipeline.bop.jsonio import abbreviate, is_number
from pipeline.bop.masks import decode_rle, read_segmentation, rle_area
from pipeline.bop.scene import Box, xyxy_from_xywh
from pipeline.errors import BadInput
from pipeline.functional.camera import mask_bbox
from pipeline.io.digests import file_digest
from pipeline.items.views import Detection, Target
from pipeline.spec import Positive, spec
from pipeline.stages.detect import Descriptors, Detector, SearchPlan
from pipeline.stages.detect.annotated import image_paths

DOUBTFUL = 0.5
"""Confidence of a pose below which ``search="doubtful"`` looks for the object elsewhere."""
LIKELY = 0.5
"""Confidence that a found pose needs: less than without a detector, which says that the object is in the image."""


@spec
class Json(Detector):
    """Detections in the JSON format of BOP's and CNOS's default detections, plain or gzipped.

    A list of {scene_id, image_id, category_id, score, bbox [x, y, w, h], time, segmentation}; ``time`` and
    ``segmentation`` (RLE {size, counts} or polygons [[x, y, ...], ...]) may be missing. A COCO annotation file is read
    too. Only entries of the targets' images and objects are read. Ids, boxes and masks are checked against each other,
    the images and the targets: see ``bop/detection_checks.py``.

    ``keep``: how many detections of a target are kept, best score first: the target's "inst_count", a number, or "all".
    Entries that cannot be used (``defect`` says why) only fill up what usable ones leave open.

    ``search``: which targets are searched for in the whole photograph (see SearchPlan): none ("none"), those without a
    usable detection ("missing"), or also those whose pose has a confidence below 0.5 ("doubtful"). What is found needs
    a confidence of 0.5, and a higher one than the given detection's.
    """

    kind: ClassVar[str] = "detect.json"
    version: ClassVar[int] = 2
    gives_boxes: ClassVar[bool] = True
    added: ClassVar[Mapping[str, Any]] = {"search": "none"}

    path: str = ""
    keep: Literal["inst_count", "all"] | Positive = "inst_count"
    search: Literal["none", "missing", "doubtful"] = "none"

    @property
    def summary(self) -> str:
        """As Detector.summary, with the file's name."""
        searched = "" if self.search == "none" else f", {self.search} ones searched for"
        return f"detections of {Path(self.path).name}{searched}"

    @property
    def search_plan(self) -> SearchPlan | None:
        """As Detector.search_plan."""
        if self.search == "none":
            return None
        return SearchPlan(min_confidence=LIKELY, doubtful=DOUBTFUL if self.search == "doubtful" else 0.0)

    def recipe(self) -> dict[str, Any]:
        """As Spec.recipe, with the file's digest instead of its path."""
        return super().recipe() | {"path": file_digest(self._file())}

    def sources(self, dataset: Dataset, targets: Sequence[Target]) -> list[Path]:
        """The file, and the images (for their size)."""
        return [self._file(), *image_paths(dataset, targets)]

    def __call__(
        self, dataset: Dataset, targets: Sequence[Target], descriptors: Descriptors | None = None
    ) -> list[Detection]:
        """The kept detections of each target, best score first.

        Raises BadInput for a file in another format, or one that fits neither targets nor images.
        """
        entries, _ = self._read(dataset, targets)
        by_target: dict[tuple[int, int, int], list[dict[str, Any]]] = defaultdict(list)
        for entry in entries:
            by_target[entry.target].append(entry.record)
        return [
            detection
            for target in targets
            for detection in self._select(dataset, target, by_target[target.scene_id, target.im_id, target.obj_id])
        ]

    def warnings(self, dataset: Dataset, targets: Sequence[Target]) -> list[str]:
        """Results of the checks on the whole file."""
        return self._read(dataset, targets)[1]

    def _read(self, dataset: Dataset, targets: Sequence[Target]) -> tuple[list[Entry], list[str]]:
        """Entries of the targets, and warnings. Ids are compared with all targets of the dataset, selected or not."""
        path = self._file()
        entries, warnings = read_entries(path, dataset.targets)
        warnings += check_ids(path, entries, dataset.targets)
        if dataset.image_note:
            warnings.append(f"{path.name}: its boxes and masks are taken to be those of the {dataset.image_note}")
        asked = {(target.scene_id, target.im_id, target.obj_id) for target in targets}
        entries = [entry for entry in entries if entry.target in asked]
        return entries, warnings + check_boxes_and_masks(path, entries, dataset.image_size)

    def _file(self) -> Path:
        if not self.path:
            raise BadInput("detect.path", found="''", needed="the path of a detections file (.json or .json.gz)")
        return Path(self.path).expanduser()

    def _select(self, dataset: Dataset, target: Target, entries: list[dict[str, Any]]) -> list[Detection]:
        if not entries:
            return []
        size_hw = dataset.image_size(target.scene_id, target.im_id)
        count = target.inst_count if self.keep == "inst_count" else len(entries) if self.keep == "all" else self.keep
        usable: list[Detection] = []
        broken: list[Detection] = []
        for entry in sorted(entries, key=lambda e: -_read_score(e)):  # stable: ties in file order
            detection = _read_detection(entry, target, size_hw)
            (broken if detection.defect else usable).append(detection)
            if len(usable) == count:
                break
        return (usable + broken)[:count]


def _read_detection(entry: dict[str, Any], target: Target, size_hw: tuple[int, int]) -> Detection:
    ids = target.scene_id, target.im_id, target.obj_id
    score, time = _read_score(entry), entry.get("time", -1.0)
    time_s = float(time) if is_number(time) and math.isfinite(time) else -1.0
    try:
        if not math.isfinite(score):
            raise ValueError(f"score is {abbreviate(entry['score'])}, not a finite number")
        rle = _read_mask(entry.get("segmentation"), size_hw)
        box = _read_box(entry.get("bbox"), rle, size_hw)
    except ValueError as error:
        return Detection(*ids, score if math.isfinite(score) else 0.0, time_s, (0.0,) * 4, defect=str(error))
    return Detection(*ids, score, time_s, box, rle)


def _read_mask(segmentation: Any, size_hw: tuple[int, int]) -> dict[str, Any] | None:
    rle = read_segmentation(segmentation, size_hw)
    if rle is not None and not rle_area(rle):
        raise ValueError("mask is empty")
    return rle


def _read_box(bbox_xywh: Any, rle: dict[str, Any] | None, size_hw: tuple[int, int]) -> Box:
    """Edges of the entry's box, or of its mask where it has none. Raises ValueError."""
    if bbox_xywh is None and rle is not None:
        return mask_bbox(decode_rle(rle)) or (0.0,) * 4
    if not isinstance(bbox_xywh, list) or len(bbox_xywh) != 4 or not all(is_number(v) for v in bbox_xywh):
        raise ValueError(f"bbox is {abbreviate(bbox_xywh)}, not 4 numbers")
    if not all(map(math.isfinite, bbox_xywh)):
        raise ValueError(f"bbox is {bbox_xywh}, not finite")
    x0, y0, x1, y1 = box = xyxy_from_xywh([float(v) for v in bbox_xywh])
    if rle is None and (x1 <= x0 or y1 <= y0):
        raise ValueError(f"bbox {bbox_xywh} has no area")
    h, w = size_hw
    if rle is None and (x1 <= -0.5 or y1 <= -0.5 or x0 >= w - 0.5 or y0 >= h - 0.5):
        raise ValueError(f"bbox {bbox_xywh} lies outside the image of {w} x {h} (width x height)")
    return box


def _read_score(entry: dict[str, Any]) -> float:
    """The entry's score; -inf, which sorts last, if it is not a finite number."""
    score = entry["score"]
    return float(score) if is_number(score) and math.isfinite(score) else -math.inf
