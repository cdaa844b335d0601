"""ground-truth masks -> detections."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

from pipeline.bop.dataset import Dataset
from pipeline.bop.masks import encode_rle
from pipeline.bop.scene import GroundTruth
from pipeline.errors import BadInput
from pipeline.functional.camera import mask_bbox
from pipeline.io.digests import file_exists
from pipeline.items.views import Detection, Target
from pipeline.spec import spec
from pipeline.stages.detect import Descriptors, Detector
from pipeline.stages.detect.annotated import annotation_paths, image_paths, select_instances


@spec
class GtMask(Detector):
    """Masks of annotated instances, score 1, the ``inst_count`` most visible of each target.

    ``visible``: the visible part (mask_visib/), otherwise the full silhouette (mask/). A mask that is missing, broken,
    empty or of another size than its image becomes a Detection with a defect.
    """

    kind: ClassVar[str] = "detect.gt_mask"
    version: ClassVar[int] = 2

    visible: bool = True

    @property
    def summary(self) -> str:
        """As Detector.summary."""
        return "ground-truth masks (oracle)" if self.visible else "ground-truth silhouettes (oracle)"

    def sources(self, dataset: Dataset, targets: Sequence[Target]) -> list[Path]:
        """Annotations of the scenes, the images (for their size), and the masks that exist.

        Raises BadInput if there is no mask at all, as after BlenderProc.
        """
        masks = [
            dataset.mask_path(target.scene_id, target.im_id, gt.gt_id, visible=self.visible)
            for target in targets
            for gt in select_instances(dataset, target)
        ]
        files = annotation_paths(dataset, targets) + image_paths(dataset, targets)
        existing = [path for path in masks if file_exists(path)]
        if masks and not existing:
            needed = "masks (bop_toolkit's calc_gt_masks.py makes them), or detect=json, cnos, gt_bbox"
            raise BadInput(masks[0].parent, found=f"none of the {len(masks)} masks of the targets", needed=needed)
        return files + existing

    def __call__(
        self, dataset: Dataset, targets: Sequence[Target], descriptors: Descriptors | None = None
    ) -> list[Detection]:
        """One detection per annotated instance of the targets."""
        return [
            self._read_detection(dataset, target, gt) for target in targets for gt in select_instances(dataset, target)
        ]

    def _read_detection(self, dataset: Dataset, target: Target, gt: GroundTruth) -> Detection:
        ids = target.scene_id, target.im_id
        path = dataset.mask_path(*ids, gt.gt_id, visible=self.visible).relative_to(dataset.root)
        box = gt.bbox_visib_xyxy or (0.0, 0.0, 0.0, 0.0)
        try:
            mask = dataset.mask(*ids, gt.gt_id, visible=self.visible)
        except BadInput as error:
            unread = f"{path}: found {error.found}, needs {error.needed}"  # a relative path: defects enter keys
            return Detection(*ids, gt.obj_id, 1.0, 0.0, box, None, gt.gt_id, unread)
        defect, size_hw = None, dataset.image_size(*ids)
        if mask.shape != size_hw:
            defect = f"mask of {list(mask.shape)} where the image is {list(size_hw)} (height, width)"
        elif not mask.any():
            defect = "mask is empty"
        return Detection(*ids, gt.obj_id, 1.0, 0.0, mask_bbox(mask) or box, encode_rle(mask), gt.gt_id, defect)
