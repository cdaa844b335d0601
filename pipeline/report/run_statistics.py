"""Statistics of one run, or of two runs on the same instances: recalls with intervals, template accuracy."""

from __future__ import annotations

import numpy as np

from pipeline.items.scores import Scores
from pipeline.metrics.bootstrap import Interval, image_index, mean_interval, paired_interval
from pipeline.metrics.recall import instance_ar
from pipeline.metrics.template_error import ACC_DEG
from pipeline.report.run_records import RunRecord


def ar_interval(scores: Scores, *, theta_max: float = 0.5) -> Interval:
    """Mean recall over instances (AR if VSD is available), with its 95 % interval over images."""
    return mean_interval(instance_ar(scores, theta_max=theta_max), image_index(scores.scene_id, scores.im_id))


def ar_name(scores: Scores) -> str:
    """Name of the mean recall in a sentence; without VSD it is not BOP's AR."""
    return "mean of AR_MSSD and AR_MSPD" if scores.vsd is None else "AR"


def ar_column(scores: Scores) -> str:
    """Name of the mean recall as a column heading."""
    return "AR_MSSD+MSPD" if scores.vsd is None else "AR"


def same_metric(ours: RunRecord, theirs: RunRecord) -> bool:
    """Whether the mean recalls of two runs are the same quantity: both with VSD or both without."""
    return (ours.require_scores().vsd is None) == (theirs.require_scores().vsd is None)


def paired_difference(ours: RunRecord, theirs: RunRecord) -> Interval | None:
    """Difference of mean recall, paired over images; None if the runs have other instances or another metric."""
    a, b = ours.require_scores(), theirs.require_scores()
    if a.instances() != b.instances() or not same_metric(ours, theirs):
        return None
    return paired_interval(instance_ar(a), instance_ar(b), image_index(a.scene_id, a.im_id))


def template_angles_deg(run: RunRecord, reading: str) -> np.ndarray:
    """Angles between matched template and true view, in a reading of TemplateError, where a template was matched."""
    return np.array([getattr(error, reading) for error in run.templates.values()])


def acc15(run: RunRecord, reading: str) -> float:
    """Share of all instances whose template is within 15 degrees of the true view; NaN if no template is known."""
    angles = template_angles_deg(run, reading)
    return float((angles < ACC_DEG).sum() / max(len(run.require_scores()), 1)) if len(angles) else float("nan")
