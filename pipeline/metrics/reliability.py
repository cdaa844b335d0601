"""confidence and truth -> how far the confidence can be trusted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

BINS = 10
RIGHT = 0.2
"""Of the diameter: a pose with a smaller MSSD is right."""


@dataclass(frozen=True)
class ReliabilityBin:
    """Poses whose confidence lies in one interval: how many, their mean confidence, and the share that is right."""

    count: int
    confidence: float
    right: float


def reliability_bins(confidence: Float[np.ndarray, " n"], right: Bool[np.ndarray, " n"]) -> list[ReliabilityBin]:
    """Non-empty bins of equal width, in ascending order."""
    index = np.minimum((confidence * BINS).astype(int), BINS - 1)
    return [
        ReliabilityBin(int((index == b).sum()), float(confidence[index == b].mean()), float(right[index == b].mean()))
        for b in np.unique(index)
    ]


def calibration_error(confidence: Float[np.ndarray, " n"], right: Bool[np.ndarray, " n"]) -> float:
    """Expected calibration error: distance between confidence and share of right poses, mean over poses by bin."""
    bins = reliability_bins(confidence, right)
    return sum(b.count * abs(b.confidence - b.right) for b in bins) / max(len(confidence), 1)


def ranking_auc(confidence: Float[np.ndarray, " n"], right: Bool[np.ndarray, " n"]) -> float:
    """Probability that a right pose has a higher confidence than a wrong one; NaN if all are right or all wrong."""
    positive, negative = int(right.sum()), int((~right).sum())
    if not positive or not negative:
        return float("nan")
    from scipy.stats import rankdata  # slow to import, and most commands score nothing

    return float((rankdata(confidence)[right].sum() - positive * (positive + 1) / 2) / (positive * negative))
