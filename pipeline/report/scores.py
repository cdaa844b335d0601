"""Scores of a run -> a table for the terminal, and a summary as JSON."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np

from pipeline.items.errors import PoseErrors
from pipeline.metrics.bootstrap import Interval, image_index, mean_interval
from pipeline.metrics.recall import (
    AverageRecall,
    average_recall,
    instance_recalls,
    recall_by_object,
    recall_by_threshold,
    recall_by_visibility,
)
from pipeline.scoring import ScoringResult

ADD_LIMIT = 0.1
"""An estimate is correct if its ADD or ADI is below this share of the diameter (Hinterstoisser et al., ACCV 2012)."""


def scores_table(scored: ScoringResult, *, theta_max: float = 0.5) -> str:
    """Average recalls with intervals, by object and by visible fraction; says why VSD is missing, if it is."""
    scores = scored.scores
    recall = average_recall(scores, theta_max=theta_max)
    interval_of = intervals(scored, theta_max=theta_max)
    lines = [f"\n{'':<10}{'AR':>8}{'AR_VSD':>10}{'AR_MSSD':>10}{'AR_MSPD':>10}"]
    lines.append(_recall_line("all", recall, f"{len(scores)} instances"))
    for name in ("AR", "AR_VSD", "AR_MSSD", "AR_MSPD"):
        if name in interval_of:
            lines.append(
                f"  {name} 95 % interval over images: {interval_of[name].low:.3f} to {interval_of[name].high:.3f}"
            )
    for obj_id, object_recall in recall_by_object(scores, theta_max=theta_max).items():
        lines.append(
            _recall_line(f"object {obj_id}", object_recall, f"{int((scores.obj_id == obj_id).sum())} instances")
        )
    for (low, high), (count, visible_recall) in recall_by_visibility(scores, theta_max=theta_max).items():
        lines.append(_recall_line("visible", visible_recall, f"{low:.0%} to {high:.0%}, {count} instances"))
    lines.append(f"errors on the meshes of {scored.models}")
    if scores.no_vsd:
        lines.append(f"VSD, and with it AR, is not available: {scores.no_vsd}")
        lines.append(f"mean of AR_MSSD and AR_MSPD: {recall.mssd_mspd:.4f}")
    return "\n".join([*lines, _errors_line(scored)])


def intervals(scored: ScoringResult, *, theta_max: float = 0.5) -> dict[str, Interval]:
    """95 % bootstrap intervals over images, by metric; metrics that are not available are left out."""
    scores = scored.scores
    values, image = instance_recalls(scores, theta_max=theta_max), image_index(scores.scene_id, scores.im_id)
    columns = {"AR_VSD": values[:, 0], "AR_MSSD": values[:, 1], "AR_MSPD": values[:, 2]}
    if scores.vsd is None:
        del columns["AR_VSD"]
    else:
        columns = {"AR": values.mean(axis=1)} | columns
    return {name: mean_interval(column, image) for name, column in columns.items()}


def summary_of(scored: ScoringResult, *, theta_max: float = 0.5) -> dict[str, Any]:
    """All summary figures as JSON values; None for those that are not available."""
    scores, recall = scored.scores, average_recall(scored.scores, theta_max=theta_max)
    return {
        "metrics": metrics_of(recall) | error_recalls(scored),
        "no_vsd": scores.no_vsd,
        "instances": len(scores),
        "intervals_95": {name: [i.low, i.high] for name, i in intervals(scored, theta_max=theta_max).items()},
        "objects": {
            str(obj_id): metrics_of(object_recall)
            for obj_id, object_recall in recall_by_object(scores, theta_max=theta_max).items()
        },
        "visibility": [
            {"from": low, "to": high, "instances": count, **metrics_of(visible_recall)}
            for (low, high), (count, visible_recall) in recall_by_visibility(scores, theta_max=theta_max).items()
        ],
        "recall_by_threshold": {name: found.tolist() for name, found in recall_by_threshold(scores).items()},
    }


def metrics_of(recall: AverageRecall) -> dict[str, float | None]:
    """Average recalls by their BOP names."""
    return {"AR": recall.ar, "AR_VSD": recall.vsd, "AR_MSSD": recall.mssd, "AR_MSPD": recall.mspd}


def error_recalls(scored: ScoringResult) -> dict[str, float | None]:
    """Share of instances with ADD and ADI below 0.1 diameters; median rotation and translation errors of estimates."""
    nearest = _nearest_errors(scored)
    found = dict.fromkeys(("recall_ADD", "recall_ADI"), 0.0)
    for error in nearest:
        found["recall_ADD"] += (error.add_mm < ADD_LIMIT * error.diameter_mm) / max(len(scored.scores), 1)
        found["recall_ADI"] += (error.adi_mm < ADD_LIMIT * error.diameter_mm) / max(len(scored.scores), 1)
    medians: dict[str, float | None] = {"median_rotation_deg": None, "median_translation_mm": None}
    if nearest:
        medians["median_rotation_deg"] = float(np.median([e.symmetric_rotation_deg for e in nearest]))
        medians["median_translation_mm"] = float(np.median([e.translation_mm for e in nearest]))
    return found | {
        name: value if value is not None and np.isfinite(value) else None for name, value in medians.items()
    }


def _nearest_errors(scored: ScoringResult) -> list[PoseErrors]:
    """Errors of each estimate against its nearest instance by MSSD."""
    by_row: defaultdict[int, list[PoseErrors]] = defaultdict(list)
    for error in scored.errors:
        by_row[error.row].append(error)
    return [min(errors, key=lambda e: e.mssd_mm) for errors in by_row.values()]


def _recall_line(name: str, recall: AverageRecall, remark: str) -> str:
    cells = "".join(
        f"{'n/a' if value is None else format(value, '.4f'):>{width}}"
        for value, width in zip(metrics_of(recall).values(), (8, 10, 10, 10), strict=True)
    )
    return f"{name:<10}{cells}   {remark}"


def _errors_line(scored: ScoringResult) -> str:
    values = error_recalls(scored)
    line = f"ADD < 0.1 diameters: {values['recall_ADD']:.4f}, ADI: {values['recall_ADI']:.4f} of the instances"
    if values["median_rotation_deg"] is None or values["median_translation_mm"] is None:
        return line
    rotation, shift = values["median_rotation_deg"], values["median_translation_mm"]
    return f"{line}; medians over estimates: {rotation:.1f} degrees (symmetry-aware), {shift:.0f} mm"
