"""hypothesis -> its score; the highest-scoring hypothesis of a detection is refined and becomes its pose."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from pipeline.functional.agreement import measure_agreement
from pipeline.functional.camera import cell_affine
from pipeline.items.features import PairGeometry
from pipeline.items.online import Truth
from pipeline.spec import Spec


class HypothesisScorer(Spec, ABC):
    """Contract of a choose variant.

    ``needs_truth``: True for oracles, which receive ``truth``; no other variant sees ground truth.
    """

    needs_truth: ClassVar[bool] = False

    @abstractmethod
    def __call__(
        self, T_cam_obj: Float[np.ndarray, "4 4"], inliers: int, geometry: PairGeometry, truth: Truth | None = None
    ) -> float:
        """Score of a pose (mm), at least 0; higher is better. Never raises NoPose."""


def compare_features(T_cam_obj: Float[np.ndarray, "4 4"], geometry: PairGeometry) -> tuple[float, float]:
    """Mean cosine and covered share of the query's foreground under a pose (mm): functional.agreement, of a pair."""
    pair = geometry.pair
    K_cell = cell_affine(size=geometry.crop_size, cells=pair.query_mask.shape[-1]) @ geometry.K_crop
    masks = pair.query_mask, pair.template_mask
    return measure_agreement(pair.query, pair.template, *masks, geometry.points_obj, K_cell, T_cam_obj)
