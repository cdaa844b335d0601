"""target -> its annotated instances and files; shared by the detectors that read ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipeline.bop.dataset import Dataset
from pipeline.bop.scene import GroundTruth
from pipeline.errors import BadInput
from pipeline.io.digests import file_exists
from pipeline.items.views import Target


def select_instances(dataset: Dataset, target: Target) -> list[GroundTruth]:
    """The target's ``inst_count`` most visible instances, as bop_toolkit chooses them; ties in file order."""
    _require_annotations(dataset, target.scene_id)
    instances = [gt for gt in dataset.ground_truth(target.scene_id, target.im_id) if gt.obj_id == target.obj_id]
    return sorted(instances, key=lambda gt: -(gt.visib_fract or 0.0))[: target.inst_count]


def annotation_paths(dataset: Dataset, targets: Sequence[Target]) -> list[Path]:
    """scene_gt.json and, where it exists, scene_gt_info.json of the targets' scenes."""
    for target in targets:
        _require_annotations(dataset, target.scene_id)
    scenes = [dataset.scene(scene_id) for scene_id in sorted({target.scene_id for target in targets})]
    infos = [scene.path("scene_gt_info.json") for scene in scenes]
    return [scene.path("scene_gt.json") for scene in scenes] + [path for path in infos if file_exists(path)]


def _require_annotations(dataset: Dataset, scene_id: int) -> None:
    if not dataset.has_ground_truth(scene_id):
        path = dataset.scene(scene_id).path("scene_gt.json")
        needed = "annotations, or detect=json or cnos, which work without them, as for BOP's test sets"
        raise BadInput(path, found="no such file", needed=needed)


def image_paths(dataset: Dataset, targets: Sequence[Target]) -> list[Path]:
    """The targets' images, in whose size masks and boxes are checked."""
    return [dataset.image_path(*image) for image in sorted({(t.scene_id, t.im_id) for t in targets})]
