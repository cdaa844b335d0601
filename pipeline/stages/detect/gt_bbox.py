"""ground-truth boxes -> detections without masks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Literal

from pipeline.bop.dataset import Dataset
from pipeline.bop.jsonio import describe_place
from pipeline.bop.scene import GroundTruth
from pipeline.errors import BadInput
from pipeline.items.views import Detection, Target
from pipeline.spec import spec
from pipeline.stages.detect import Descriptors, Detector
from pipeline.stages.detect.annotated import annotation_paths, select_instances


@spec
class GtBbox(Detector):
    """Boxes of annotated instances, score 1, the ``inst_count`` most visible of each target.

    ``bbox``: around the visible part, or around the full silhouette, which may extend beyond the image. An instance
    without a box becomes a Detection with a defect.
    """

    kind: ClassVar[str] = "detect.gt_bbox"
    version: ClassVar[int] = 1
    gives_boxes: ClassVar[bool] = True

    bbox: Literal["visib", "obj"] = "visib"

    @property
    def summary(self) -> str:
        """As Detector.summary."""
        return f"ground-truth boxes{'' if self.bbox == 'visib' else ' of silhouettes'} (oracle)"

    def sources(self, dataset: Dataset, targets: Sequence[Target]) -> list[Path]:
        """Annotations of the scenes."""
        return annotation_paths(dataset, targets)

    def __call__(
        self, dataset: Dataset, targets: Sequence[Target], descriptors: Descriptors | None = None
    ) -> list[Detection]:
        """One detection per annotated instance. Raises BadInput for a scene without scene_gt_info.json."""
        for scene_id in sorted({target.scene_id for target in targets}):
            path = dataset.scene(scene_id).path("scene_gt_info.json")
            if not path.exists():
                raise BadInput(
                    describe_place(path, scene=scene_id), found="no such file", needed=f"bbox_{self.bbox} of instances"
                )
        return [self._read_detection(target, gt) for target in targets for gt in select_instances(dataset, target)]

    def _read_detection(self, target: Target, gt: GroundTruth) -> Detection:
        box = gt.bbox_visib_xyxy if self.bbox == "visib" else gt.bbox_obj_xyxy
        defect = None if box else f"bbox_{self.bbox} has no area"
        ids = target.scene_id, target.im_id, target.obj_id
        return Detection(*ids, 1.0, 0.0, box or (0.0, 0.0, 0.0, 0.0), None, gt.gt_id, defect)
