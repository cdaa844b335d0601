"""hypothesis -> how well the template, moved to its pose, explains what the query shows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from pipeline.items.features import PairGeometry
from pipeline.items.online import Truth
from pipeline.spec import NonNegativeFloat, PositiveFloat, spec
from pipeline.stages.choose import HypothesisScorer, compare_features


@spec
class Agreement(HypothesisScorer):
    """Mean cosine to the power of ``cosine_power``, times coverage, times inliers to the power of ``inlier_power``.

    The template's cells are projected into the query under the pose: the mean cosine compares their descriptors with
    the query's at those places, coverage is the share of the query's foreground that they reach
    (functional.agreement). A wrong template can have many inliers for a pose that explains only a part of the object;
    its cosine and coverage are low.
    """

    kind: ClassVar[str] = "choose.agreement"
    version: ClassVar[int] = 1
    added: ClassVar[Mapping[str, Any]] = {"cosine_power": 1.0}

    inlier_power: NonNegativeFloat = 0.5
    cosine_power: PositiveFloat = 1.0

    def __call__(
        self, T_cam_obj: Float[np.ndarray, "4 4"], inliers: int, geometry: PairGeometry, truth: Truth | None = None
    ) -> float:
        """The product; 0 where the template lands outside the query's foreground."""
        cosine, coverage = compare_features(T_cam_obj, geometry)
        return max(cosine, 0.0) ** self.cosine_power * coverage * inliers**self.inlier_power
