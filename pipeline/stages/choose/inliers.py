"""hypothesis -> the number of correspondences that agree with its pose."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from jaxtyping import Float

from pipeline.items.features import PairGeometry
from pipeline.items.online import Truth
from pipeline.spec import spec
from pipeline.stages.choose import HypothesisScorer


@spec
class Inliers(HypothesisScorer):
    """The hypothesis with most inliers wins (FoundPose, Örnek et al., ECCV 2024)."""

    kind: ClassVar[str] = "choose.inliers"
    version: ClassVar[int] = 1

    def __call__(
        self, T_cam_obj: Float[np.ndarray, "4 4"], inliers: int, geometry: PairGeometry, truth: Truth | None = None
    ) -> float:
        """The number of inliers."""
        return float(inliers)
