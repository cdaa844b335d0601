"""true pose, hypothesis -> its score by its true error: an upper bound for scorers, not a method."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from jaxtyping import Float

from pipeline.errors import BadInput
from pipeline.functional.rigid import transform
from pipeline.items.features import PairGeometry
from pipeline.items.online import Truth
from pipeline.spec import spec
from pipeline.stages.choose import HypothesisScorer


@spec
class Oracle(HypothesisScorer):
    """The hypothesis nearest to the true pose wins, symmetries considered.

    The distance to any other scorer's result is what choosing loses: nothing but the choice changes.
    """

    kind: ClassVar[str] = "choose.oracle"
    version: ClassVar[int] = 1
    needs_truth: ClassVar[bool] = True

    def __call__(
        self, T_cam_obj: Float[np.ndarray, "4 4"], inliers: int, geometry: PairGeometry, truth: Truth | None = None
    ) -> float:
        """1 / (1 + error), the error (mm) being the largest of the template's visible points."""
        if truth is None:
            raise BadInput("choose=oracle", found="features", needed="the true pose, from detections of ground truth")
        points = geometry.points_obj[np.isfinite(geometry.points_obj).all(axis=1)]
        placed = transform(T_cam_obj, points)
        errors = [np.linalg.norm(placed - transform(truth.T_cam_obj @ S, points), axis=1) for S in truth.symmetries]
        return 1 / (1 + float(np.max(errors, axis=1, initial=0.0).min()))
