"""hypothesis -> its score; the highest-scoring hypothesis of a detection is refined and becomes its pose."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from jaxtyping import Float

from pipeline.items.features import PairGeometry
from pipeline.spec import Spec


class HypothesisScorer(Spec, ABC):
    """Contract of a choose variant. It never sees ground truth."""

    @abstractmethod
    def __call__(self, T_cam_obj: Float[np.ndarray, "4 4"], inliers: int, geometry: PairGeometry) -> float:
        """Score of a pose (mm), at least 0; higher is better. Never raises NoPose."""
