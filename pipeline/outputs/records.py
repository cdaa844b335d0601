"""Answers, evaluation -> the run's record, from which reports are made; and the record of a job that failed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.graph import PoseEvaluation
from pipeline.items.errors import TemplateError
from pipeline.items.poses import NoEstimate, PoseEstimate
from pipeline.items.records import Answer, answer_to_record
from pipeline.metrics.reliability import RIGHT
from pipeline.metrics.template_error import ACC_DEG
from pipeline.outputs.folder import OutputFolder
from pipeline.report.run_records import Case, RunRecord, finished_run_record, run_id, write_run_record
from pipeline.report.scores import summary_of
from pipeline.scoring import dataset_id
from pipeline.spec import digest

_ANSWER_FIELDS = ("status", "scene_id", "im_id", "obj_id", "detection_id", "T_cam_obj", "score")


def write_record(
    folder: OutputFolder, answers: Sequence[Answer], evaluation: PoseEvaluation, cases: Sequence[Case]
) -> Path:
    """Write the run's record; returns its file."""
    record = _make_record(folder, answers, evaluation, cases)
    before = folder.earlier_record()
    if before is not None:  # the counts of the run that computed the results say more than "all reused"
        record = replace(record, at=before.at, counts=before.counts, sweep=before.sweep)
    return write_run_record(folder.out, record)


def write_failure_record(out: str, config: Mapping[str, Any], overrides: Sequence[str], message: str) -> None:
    """Write the record of a job that failed, unless the same configuration has succeeded before."""
    id_ = run_id(config)
    if finished_run_record(Path(out), id_) is not None:
        return
    record = RunRecord(
        id=id_,
        status="failed",
        at=_now(),
        method=str(config.get("method", "")),
        config=config,
        label={},
        error=message,
        overrides=tuple(overrides),
        sweep=str(config.get("sweep") or ""),
    )
    write_run_record(Path(out), record)


def _make_record(
    folder: OutputFolder, answers: Sequence[Answer], evaluation: PoseEvaluation, cases: Sequence[Case]
) -> RunRecord:
    assert folder.scores is not None
    context, options = folder.context, folder.options
    summary = summary_of(evaluation.scored, theta_max=options.evaluate.theta_max)
    failures = Counter((a.stage, a.reason) for a in answers if isinstance(a, NoEstimate))
    return RunRecord(
        id=run_id(options.config),
        status="done",
        at=_now(),
        method=options.name,
        config=options.config,
        label=options.label,
        sweep=options.sweep or "",
        notice=context.stages.extract.notice,
        detections=context.stages.detect.summary,
        dataset=dataset_id(folder.scores.scorer),
        run=folder.scores.ref.key,
        folder=folder.path.relative_to(folder.out).as_posix(),
        csv=folder.csv_name,
        answers=digest_answers(answers),
        estimates=sum(isinstance(answer, PoseEstimate) for answer in answers),
        counts=context.progress.as_record(),
        times_s=_median_times(answers),
        bytes_per_object=folder.graph.templates.feature_bytes() / max(len(context.object_ids), 1),
        failures=tuple((stage, reason, count) for (stage, reason), count in failures.most_common()),
        metrics=summary["metrics"] | _template_metrics(evaluation),
        scores=evaluation.scored.scores,
        templates=evaluation.templates,
        cases=tuple(cases),
        machines=tuple(folder.graph.machines()),
        confidences=confidences_of(answers, evaluation),
    )


def confidences_of(answers: Sequence[Answer], evaluation: PoseEvaluation) -> tuple[tuple[float, bool], ...]:
    """Confidence of each pose of an annotated instance, and whether the pose is right; none without a calibration."""
    return tuple(
        (answer.confidence, errors.mssd_mm < RIGHT * errors.diameter_mm)
        for answer, errors in zip(answers, evaluation.by_answer, strict=True)
        if isinstance(answer, PoseEstimate) and answer.confidence is not None and errors is not None
    )


def digest_answers(answers: Sequence[Answer]) -> str:
    """Digest of what was answered for every target: pose and score, or none. How it came about does not count."""
    records = [answer_to_record(answer) for answer in answers]
    return digest([{name: record.get(name) for name in _ANSWER_FIELDS} for record in records])


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="microseconds")


def _median_times(answers: Sequence[Answer]) -> dict[str, float]:
    """Median seconds of a pose by stage."""
    times = [answer.times_s for answer in answers if isinstance(answer, PoseEstimate)]
    stages = dict.fromkeys(stage for by_stage in times for stage in by_stage)
    return {stage: float(np.median([by_stage.get(stage, 0.0) for by_stage in times])) for stage in stages}


def _template_metrics(evaluation: PoseEvaluation) -> dict[str, float | None]:
    """Acc15 in its three readings over all instances, and mean angles over instances with a matched template."""
    metrics: dict[str, float | None] = {}
    instances = max(len(evaluation.scored.scores), 1)
    for reading in (f.name for f in fields(TemplateError)):
        angles = np.array([getattr(error, reading) for error in evaluation.templates.values()])
        metrics[f"Acc{ACC_DEG:.0f}_{reading}"] = float((angles < ACC_DEG).sum() / instances)
        metrics[f"template_error_{reading}_deg"] = float(angles.mean()) if len(angles) else None
    if evaluation.correspondences:
        median = float(np.median(list(evaluation.correspondences.values())))
        metrics["correspondence_error_percent"] = 100 * median
    return metrics
