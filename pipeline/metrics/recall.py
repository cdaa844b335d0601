"""scores -> recalls and average recalls, as the BOP challenge defines them (Hodan et al., ECCVW 2020, section 2.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.items.scores import Scores

THETAS = np.arange(0.05, 0.51, 0.05)
"""Thresholds of correctness: for VSD, and for MSSD as a fraction of the diameter."""
TAUS = np.arange(0.05, 0.51, 0.05)
"""Misalignment tolerances of VSD, as fractions of the diameter."""
MSPD_PX = np.arange(5, 51, 5)
"""Thresholds of correctness for MSPD, in pixels of an image 640 px wide."""
VISIBILITY_BINS = ((0.0, 0.2), (0.2, 0.4), (0.4, 0.6), (0.6, 0.8), (0.8, 1.0))


@dataclass(frozen=True)
class AverageRecall:
    """Average recalls, 0 to 1. ``vsd`` and ``ar`` are None if VSD was not computed."""

    vsd: float | None
    mssd: float
    mspd: float

    @property
    def ar(self) -> float | None:
        """BOP's AR: mean of AR_VSD, AR_MSSD and AR_MSPD. None without VSD."""
        return None if self.vsd is None else (self.vsd + self.mssd + self.mspd) / 3

    @property
    def mssd_mspd(self) -> float:
        """Mean of AR_MSSD and AR_MSPD. This is not BOP's AR; do not report it as such."""
        return (self.mssd + self.mspd) / 2


def average_recall(scores: Scores, *, theta_max: float = 0.5) -> AverageRecall:
    """Average recalls over instances and thresholds; 0 without instances.

    ``theta_max`` excludes the thresholds above it (as in the paper's figure "AR over error tolerance threshold"): theta
    for VSD and MSSD, 100 theta pixels for MSPD. VSD's tolerances tau are not affected.
    """
    recalls = instance_recalls(scores, theta_max=theta_max)
    means = recalls.mean(axis=0) if len(recalls) else np.zeros(3)
    return AverageRecall(None if scores.vsd is None else float(means[0]), float(means[1]), float(means[2]))


def instance_recalls(scores: Scores, *, theta_max: float = 0.5) -> Float[np.ndarray, "n 3"]:
    """Fraction of the thresholds at which each instance is correct, for VSD (NaN if not computed), MSSD and MSPD."""
    used = theta_max + 1e-9 >= THETAS
    vsd = np.full(len(scores), np.nan) if scores.vsd is None else scores.vsd[:, :, used].mean(axis=(1, 2))
    return np.stack([vsd, scores.mssd[:, used].mean(axis=1), scores.mspd[:, used].mean(axis=1)], axis=1)


def instance_ar(scores: Scores, *, theta_max: float = 0.5) -> Float[np.ndarray, " n"]:
    """Each instance's contribution to AR: mean recall over the available metrics."""
    recalls = instance_recalls(scores, theta_max=theta_max)
    return recalls[:, 1:].mean(axis=1) if scores.vsd is None else recalls.mean(axis=1)


def recall_by_threshold(scores: Scores) -> dict[str, Float[np.ndarray, " 10"]]:
    """Recall at each of the ten thresholds, by metric; for VSD averaged over its tolerances tau."""
    by_metric = {"mssd": scores.mssd, "mspd": scores.mspd}
    if scores.vsd is not None:
        by_metric = {"vsd": scores.vsd.mean(axis=1)} | by_metric
    return {name: hits.mean(axis=0) if len(hits) else np.zeros(10) for name, hits in by_metric.items()}


def recall_by_object(scores: Scores, *, theta_max: float = 0.5) -> dict[int, AverageRecall]:
    """Average recalls by object id."""
    objects = np.unique(scores.obj_id).tolist()
    return {obj_id: average_recall(scores.select(scores.obj_id == obj_id), theta_max=theta_max) for obj_id in objects}


def recall_by_visibility(
    scores: Scores, *, theta_max: float = 0.5
) -> dict[tuple[float, float], tuple[int, AverageRecall]]:
    """Number of instances and average recalls by bin (low, high) of the visible fraction; empty bins are omitted."""
    bins: dict[tuple[float, float], tuple[int, AverageRecall]] = {}
    for low, high in VISIBILITY_BINS:
        below = scores.visib_fract <= high if high == VISIBILITY_BINS[-1][1] else scores.visib_fract < high
        chosen = (scores.visib_fract >= low) & below
        if chosen.any():
            bins[low, high] = int(chosen.sum()), average_recall(scores.select(chosen), theta_max=theta_max)
    return bins
