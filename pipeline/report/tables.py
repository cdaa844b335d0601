"""Run records -> tables of measured results: runs, ablations, methods, times, failures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.metrics.bootstrap import Interval
from pipeline.metrics.recall import instance_recalls
from pipeline.progress import format_bytes
from pipeline.report.families import Family
from pipeline.report.names import detections_text, run_name, value_text
from pipeline.report.run_records import RunRecord
from pipeline.report.run_statistics import acc15, ar_column, ar_interval, paired_difference, template_angles_deg
from pipeline.report.table import NOT_AVAILABLE, Table

READINGS = ("geodesic", "direction", "vectorised")
COUNTED_STEPS = ("templates", "template features", "query features", "poses")


def runs_table(runs: Sequence[RunRecord], base: RunRecord) -> Table:
    """Every finished run, best first, with its paired difference from the base run."""
    ordered = sorted(runs, key=lambda run: -ar_interval(run.require_scores()).mean)
    recall = ar_column(base.require_scores())
    head = ("run", "detections", recall, "vs base", "AR_VSD", "AR_MSSD", "AR_MSPD", "Acc15", "template error", "poses",
            "s/target", "cache/object")  # fmt: skip
    caption = f"Runs on {detections_text(ordered)}. "
    caption += "Acc15 and template error: geodesic. *: significant at 95 %, paired over images."
    if base.require_scores().vsd is None:
        caption += " AR_MSSD+MSPD is the mean of the two, not BOP's AR: VSD is not available."
    return Table("runs", caption, "measured", head, tuple(_run_row(run, base) for run in ordered))


def _run_row(run: RunRecord, base: RunRecord) -> tuple[str, ...]:
    scores = run.require_scores()
    recalls = instance_recalls(scores).mean(axis=0) if len(scores) else np.full(3, np.nan)
    angles = template_angles_deg(run, "geodesic")
    return (
        run_name(run, base),
        detections_text([run]),
        _recall_cell(run, base),
        "base" if run.id == base.id else signed_text(paired_difference(run, base)),
        *map(number_text, recalls),
        number_text(acc15(run, "geodesic")),
        f"{angles.mean():.1f} deg" if len(angles) else NOT_AVAILABLE,
        f"{run.estimates}/{len(scores)}",
        f"{sum(run.times_s.values()):.2f}" if run.times_s else NOT_AVAILABLE,
        format_bytes(run.bytes_per_object) if run.bytes_per_object else NOT_AVAILABLE,
    )


def _recall_cell(run: RunRecord, base: RunRecord) -> str:
    """Mean recall in the metric of the base run, which the column is named after."""
    scores, base_has_vsd = run.require_scores(), base.require_scores().vsd is not None
    if base_has_vsd and scores.vsd is None:
        return f"{NOT_AVAILABLE}; AR_MSSD+MSPD {number_text(ar_interval(scores).mean)}"
    interval = ar_interval(scores if base_has_vsd else replace(scores, vsd=None))
    return f"{number_text(interval.mean)} ({range_text(interval)})"


def templates_table(methods: Sequence[tuple[str, RunRecord]]) -> Table:
    """Acc15 and the mean angle to the true view, in the three readings of TemplateError."""
    head = ("run", *(f"Acc15 {reading}" for reading in READINGS), *(f"error {reading}" for reading in READINGS))
    rows = []
    for name, run in methods:
        angles = [template_angles_deg(run, reading) for reading in READINGS]
        means = [f"{a.mean():.1f} deg" if len(a) else NOT_AVAILABLE for a in angles]
        rows.append((name, *(number_text(acc15(run, reading)) for reading in READINGS), *means))
    caption = "Template match, symmetry-aware: share of all instances within 15 degrees, and mean angle."
    return Table("templates", caption, "measured", head, tuple(rows))


def family_table(family: Family) -> Table:
    """The runs of one ablation, each with its paired difference from the base run."""
    rows = [
        (
            value_text(value),
            *recall_cells(run),
            "base" if run.id == family.base.id else signed_text(paired_difference(run, family.base)),
        )
        for value, run in zip(family.values, family.runs, strict=True)
    ]
    name = "ablation_" + family.axis.replace(".", "_")
    head = (family.axis, ar_column(family.base.require_scores()), "95 %", "vs base, paired")
    caption = f"Runs that differ only in {family.axis}, on {detections_text(family.runs)}."
    if family.is_flat:
        caption += f" {flat_text(family)}"
    return Table(name, caption, "measured", head, tuple(rows))


def flat_text(family: Family) -> str:
    """A note that the swept setting changed no answer."""
    return f"{family.axis} changed no answer: all {len(family.runs)} runs gave the same poses and scores."


def improvement_table(methods: Sequence[tuple[str, RunRecord]]) -> Table | None:
    """Relative improvement of the first method over each of the others; None if there is only one."""
    if len(methods) < 2:
        return None
    (our_name, ours), *others = methods
    rows = []
    for name, theirs in others:
        angle_before, angle_after = (_mean(template_angles_deg(run, "geodesic")) for run in (theirs, ours))
        recall_before, recall_after = (ar_interval(run.require_scores()).mean for run in (theirs, ours))
        rows.append(
            (
                f"{our_name} over {name}",
                _relative_gain(-angle_before, -angle_after),
                _relative_gain(acc15(theirs, "geodesic"), acc15(ours, "geodesic")),
                _relative_gain(recall_before, recall_after),
                signed_text(paired_difference(ours, theirs)),
            )
        )
    recall = ar_column(ours.require_scores())
    head = ("methods", "pose error", "Acc15", recall, f"{recall} difference, paired")
    caption = f"Relative improvement on {detections_text(run for _, run in methods)}; "
    caption += "pose error is the mean geodesic angle of the matched template."
    return Table("improvement", caption, "measured", head, tuple(rows))


def counts_table(runs: Sequence[RunRecord], base: RunRecord) -> Table:
    """What each job computed and what it reused from the cache."""
    rows = [(run_name(run, base), *(_count_cell(run, step) for step in COUNTED_STEPS)) for run in runs]
    caption = "Computed + reused, by job. A sweep over matching settings computes no templates or features."
    return Table("counts", caption, "measured", ("run", *COUNTED_STEPS), tuple(rows))


def _count_cell(run: RunRecord, step: str) -> str:
    count = run.counts.get(step)
    return NOT_AVAILABLE if count is None else f"{count['computed']:.0f} + {count['reused']:.0f}"


def times_table(runs: Sequence[tuple[str, RunRecord]]) -> Table:
    """Median seconds per target by stage, and their sum."""
    stages = list(dict.fromkeys(stage for _, run in runs for stage in run.times_s))
    rows = []
    for name, run in runs:
        seconds = [run.times_s.get(stage, 0.0) for stage in stages]
        rows.append((name, *(f"{s:.4f}" for s in seconds), f"{sum(seconds):.3f}"))
    caption = "Median seconds per target, by stage."
    return Table("times", caption, "measured", ("run", *stages, "all"), tuple(rows))


def failures_table(runs: Sequence[RunRecord], base: RunRecord) -> Table | None:
    """Reasons for targets without a pose, by run; None if every target has one."""
    rows = [(run_name(run, base), stage, reason, str(count)) for run in runs for stage, reason, count in run.failures]
    head = ("run", "stage", "reason", "targets")
    return Table("failures", "Targets without a pose.", "measured", head, tuple(rows)) if rows else None


def recall_cells(run: RunRecord) -> tuple[str, str]:
    """Mean recall and its interval."""
    interval = ar_interval(run.require_scores())
    return number_text(interval.mean), range_text(interval)


def signed_text(difference: Interval | None) -> str:
    """A difference with its interval, starred if the interval excludes 0."""
    if difference is None:
        return NOT_AVAILABLE
    star = " *" if difference.excludes_zero else ""
    return f"{difference.mean:+.3f} ({difference.low:+.3f} to {difference.high:+.3f}){star}"


def number_text(value: float) -> str:
    """Three decimals; n/a for NaN."""
    return f"{value:.3f}" if np.isfinite(value) else NOT_AVAILABLE


def range_text(interval: Interval) -> str:
    """The bounds of an interval."""
    return f"{number_text(interval.low)} to {number_text(interval.high)}"


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _relative_gain(before: float, after: float) -> str:
    """Gain relative to the size of ``before``; negate both values if less is better."""
    if not (np.isfinite(before) and np.isfinite(after)) or before == 0:
        return NOT_AVAILABLE
    return f"{(after - before) / abs(before):+.1%}"
