"""Poses that are expected before an image is looked at: the user's, or in a video those of the frame before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.errors import BadInput
from pipeline.graph.context import Context
from pipeline.graph.extents import ExtentNodes
from pipeline.items.online import Prior
from pipeline.items.poses import PoseEstimate
from pipeline.items.records import Answer
from pipeline.items.views import Detection, Target
from pipeline.tracking import TRACKING_VERSION


@dataclass(frozen=True, eq=False)
class Priors:
    """The expected poses of a run's detections."""

    context: Context
    extents: ExtentNodes

    def check(self) -> None:
        """Raise BadInput for a video and a method that cannot follow an object."""
        follows = self.context.dataset.is_video and len(self.context.image_ids) > 1
        if follows and not self.context.stages.second_look.hypotheses:
            needed = "method=dzop_x or second_look=drawn: poses are followed by rendering the object in them"
            raise BadInput("dataset.video", found="with second_look=none", needed=needed)

    def recipe(self, targets: Sequence[Target]) -> dict[str, Any]:
        """What the poses of an object's targets depend on; empty without priors."""
        data = self.context.dataset
        if data.is_video:
            return {"prior": [TRACKING_VERSION, "video", [target.im_id for target in targets]]}
        given = [data.prior(target.obj_id, nth) for target in targets for nth in range(target.inst_count)]
        if all(T_cam_obj is None for T_cam_obj in given):
            return {}
        return {"prior": [TRACKING_VERSION, [None if T is None else T.tolist() for T in given]]}

    def prior(self, d: Detection, nth: int, before: Sequence[Answer]) -> Prior | None:
        """The expected pose of a detection, the ``nth`` of its object. ``before``: answers of the frame before."""
        T_cam_obj = self.context.dataset.prior(d.obj_id, nth)
        last = before[nth] if self.context.dataset.is_video and nth < len(before) else None
        if isinstance(last, PoseEstimate):
            T_cam_obj = last.T_cam_obj
        return None if T_cam_obj is None else Prior(T_cam_obj, self.extents.read(d.obj_id).symmetries)
