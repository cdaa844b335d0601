"""proposals, templates -> detections (Nguyen et al., ICCVW 2023, "CNOS")."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.backbones.extractor import Extractor
from pipeline.bop.dataset import Dataset
from pipeline.functional.boxes import non_maximum_suppression
from pipeline.functional.descriptors import mean_top_cosine
from pipeline.items.features import CLASS_TOKEN_LAYER
from pipeline.items.views import Detection, Proposal, Target
from pipeline.spec import Fraction, Positive, spec
from pipeline.stages.detect import Describer, Descriptors, Detector, ImageDescriptors
from pipeline.stages.detect.proposals import Proposer
from pipeline.stages.detect.proposals.sam import Sam


@spec
class Cnos(Detector):
    """Assigns each proposal to the object whose templates it resembles most, if its score is high enough.

    ``describe``: the extract variant for descriptors; ``describe_layer``: its class token (-2), or a layer that is
    averaged over the mask. A proposal's score for an object is the mean of its ``best`` highest cosines with the
    object's templates, and must exceed ``min_score``. ``nms_iou``: of two boxes of one object with a larger IoU, the
    one with the lower score is dropped. ``max_per_image``: maximum number of detections of the targets' objects in an
    image. ``keep``: maximum number per target, as in detect=json.

    Differences to the paper: templates and crops are those of the route.
    """

    kind: ClassVar[str] = "detect.cnos"
    finds_objects: ClassVar[bool] = True
    version: ClassVar[int] = 1

    describe: Extractor
    proposals: Proposer = field(default_factory=Sam)
    describe_layer: int = CLASS_TOKEN_LAYER
    best: Positive = 5
    min_score: Fraction = 0.15
    nms_iou: Fraction = 0.25
    max_per_image: Positive = 100
    keep: Literal["inst_count", "all"] | Positive = "inst_count"

    @property
    def summary(self) -> str:
        """As Detector.summary."""
        return "masks by CNOS"

    @property
    def describer(self) -> Describer:
        """``describe``, ``describe_layer`` and ``proposals``."""
        return Describer(self.proposals, self.describe, self.describe_layer)

    def __call__(
        self, dataset: Dataset, targets: Sequence[Target], descriptors: Descriptors | None = None
    ) -> list[Detection]:
        """At least one detection per target; if none was found, one whose ``defect`` says why."""
        assert descriptors is not None, "the graph computes descriptors for a detector with a describer"
        found: list[Detection] = []
        for image in sorted({(target.scene_id, target.im_id) for target in targets}):
            in_image = [target for target in targets if (target.scene_id, target.im_id) == image]
            found += self._detect(in_image, descriptors.of_image(image), descriptors.templates)
        return found

    def _detect(
        self, targets: Sequence[Target], image: ImageDescriptors, templates: Mapping[int, Float[Tensor, "n c"]]
    ) -> list[Detection]:
        """Detections of one image's targets."""
        proposals, time_s = image.proposals, image.time_s
        assigned = _assign(image.descriptors, templates, best=self.best)
        ranked = self._rank(targets, proposals, assigned)
        found: list[Detection] = []
        for target in targets:
            ids = target.scene_id, target.im_id, target.obj_id
            chosen = [i for i in ranked if assigned.obj_id[i] == target.obj_id][: self._count(target)]
            found += [
                Detection(*ids, float(assigned.score[i]), time_s, proposals[i].bbox_xyxy, proposals[i].rle)
                for i in chosen
            ]
            if not chosen:
                reason = self._explain(target, assigned)
                found.append(Detection(*ids, 0.0, time_s, (0.0, 0.0, 0.0, 0.0), defect=reason))
        return found

    def _rank(self, targets: Sequence[Target], proposals: Sequence[Proposal], assigned: _Assignment) -> list[int]:
        """Proposals that are detections of the targets' objects, best score first."""
        boxes = np.array([p.bbox_xyxy for p in proposals]).reshape(-1, 4)
        kept = np.zeros(len(proposals), bool)
        for obj_id in {target.obj_id for target in targets}:
            of_object = np.flatnonzero((assigned.obj_id == obj_id) & (assigned.score > self.min_score))
            kept[of_object] = non_maximum_suppression(boxes[of_object], assigned.score[of_object], max_iou=self.nms_iou)
        best_first = np.argsort(-assigned.score, kind="stable").tolist()
        return [i for i in best_first if kept[i]][: self.max_per_image]

    def _count(self, target: Target) -> int | None:
        if self.keep == "all":
            return None
        return target.inst_count if self.keep == "inst_count" else self.keep

    def _explain(self, target: Target, assigned: _Assignment) -> str:
        """Why a target has no detection."""
        proposals, scores = len(assigned.score), assigned.score[assigned.obj_id == target.obj_id]
        if not proposals:
            return "no mask was proposed in the image"
        if not len(scores):
            return f"each of {proposals} proposals looks more like another object than like object {target.obj_id}"
        if scores.max() <= self.min_score:
            return f"the best of {proposals} proposals scores {scores.max():.2f}, needs more than {self.min_score:g}"
        return f"the image has {self.max_per_image} detections of higher score, all that it may have"


@dataclass(frozen=True, eq=False)
class _Assignment:
    """Each proposal's best object and its score for it."""

    obj_id: Int[np.ndarray, " p"]
    score: Float[np.ndarray, " p"]


def _assign(
    descriptors: Float[Tensor, "p c"], templates: Mapping[int, Float[Tensor, "n c"]], *, best: int
) -> _Assignment:
    objects = sorted(templates)
    scores = torch.stack([mean_top_cosine(descriptors, templates[obj_id], best=best) for obj_id in objects], dim=1)
    found = scores.max(dim=1)
    return _Assignment(np.array(objects)[found.indices.cpu().numpy()], found.values.double().cpu().numpy())
