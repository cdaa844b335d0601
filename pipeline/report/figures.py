"""Run records -> figures. Measured results are solid and filled; published ones are grey, dashed and hollow.

Published results have axes of their own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes

from pipeline.items.scores import Scores
from pipeline.metrics.recall import MSPD_PX, THETAS, recall_by_threshold, recall_by_visibility
from pipeline.metrics.reliability import calibration_error, ranking_auc, reliability_bins
from pipeline.report import published
from pipeline.report.families import Family
from pipeline.report.names import AXIS_TITLES, detections_text, value_text
from pipeline.report.plotting import (
    COLOURS,
    GREY,
    METRIC_COLOURS,
    STYLE,
    Figure,
    add_legend,
    error_bars,
    one_panel,
    two_panels,
    wrap_name,
)
from pipeline.report.run_records import RunRecord
from pipeline.report.run_statistics import ar_interval, ar_name

MAX_BARS = 36  # in one figure; narrower bars cannot be distinguished on a phone
_STAGE_COLOURS = (*COLOURS, GREY, "#b8bcc4", "#6b4c9a")


@mpl.rc_context(STYLE)
def objects_figures(runs: Mapping[str, RunRecord], dataset: str) -> list[Figure]:
    """Bars of recall by object, a few objects per figure; on the paper's datasets its bars are below."""
    objects = np.unique(_first_scores(runs).obj_id)
    bars = max(len(runs), len(published.OBJECTS.get(dataset, {})))
    parts = np.array_split(objects, -(-len(objects) * bars // MAX_BARS)) if len(objects) else [objects]
    return [_objects_figure(runs, dataset, part.tolist()) for part in parts if len(part) or len(parts) == 1]


@dataclass(frozen=True)
class _BarGroups:
    """Positions of ``bars`` bars side by side at each of ``groups`` places."""

    groups: int
    bars: int

    @property
    def pitch(self) -> float:
        return 0.8 / self.bars

    @property
    def width(self) -> float:
        return 0.92 * self.pitch

    def positions(self, bar: int) -> np.ndarray:
        return np.arange(self.groups) + (bar - (self.bars - 1) / 2) * self.pitch


def _objects_figure(runs: Mapping[str, RunRecord], dataset: str, objects: Sequence[int]) -> Figure:
    first, theirs = _first_scores(runs), published.OBJECTS.get(dataset)
    if theirs:
        canvas, (axes, below) = two_panels()
        _draw_published_bars(below, theirs, objects, dataset)
    else:
        canvas, axes = one_panel()
    groups = _BarGroups(len(objects), len(runs))
    for k, (name, run) in enumerate(runs.items()):
        scores, x = run.require_scores(), groups.positions(k)
        intervals = [ar_interval(scores.select(scores.obj_id == obj_id)) for obj_id in objects]
        means = [i.mean for i in intervals]
        axes.bar(x, means, groups.width, color=COLOURS[k % len(COLOURS)], label=wrap_name(name))
        axes.errorbar(x, means, error_bars(intervals), fmt="none", ecolor="#40464f", elinewidth=0.8)
    axes.set_xticks(range(len(objects)), [str(obj_id) for obj_id in objects])
    axes.set(xlabel="" if theirs else "object", ylabel=_ar_label(first), ylim=(0, 1.02))
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, columnspacing=1.2, handlelength=1.4, borderpad=0)
    which = f"objects {objects[0]} to {objects[-1]}" if len(objects) > 1 else "object"
    caption = f"{ar_name(first)}, {which}, with 95 % intervals over images, on {detections_text(runs.values())}."
    if theirs:
        caption += " Below, the paper's bars on axes of their own: their mean is not its AR."
    return Figure("objects", caption, canvas)


def _draw_published_bars(
    axes: Axes, theirs: Mapping[str, Mapping[int, float]], objects: Sequence[int], dataset: str
) -> None:
    groups = _BarGroups(len(objects), len(theirs))
    styles: list[dict[str, Any]] = [{"fill": False, "linestyle": "--"}, {"color": "#e9ebee", "linestyle": "--"}]
    for k, (name, values) in enumerate(theirs.items()):
        heights = [values.get(obj_id, np.nan) for obj_id in objects]
        axes.bar(groups.positions(k), heights, groups.width, edgecolor=GREY, label=name, **styles[k % 2])
    axes.set(xlabel="object", ylabel="the paper's bars", ylim=(0, 1.02))
    axes.set_title(f"published, {published.DATASETS[dataset]}; not AR", color=GREY)
    add_legend(axes)


@mpl.rc_context(STYLE)
def theta_figure(runs: Mapping[str, RunRecord], dataset: str) -> Figure:
    """Recall over the upper bound of theta; measured above, published below."""
    canvas, (axes, below) = two_panels()
    for k, (name, run) in enumerate(runs.items()):
        intervals = [ar_interval(run.require_scores(), theta_max=float(bound)) for bound in THETAS]
        colour = COLOURS[k % len(COLOURS)]
        low, high = [i.low for i in intervals], [i.high for i in intervals]
        axes.plot(THETAS, [i.mean for i in intervals], "o-", color=colour, label=wrap_name(name))
        axes.fill_between(THETAS, low, high, color=colour, alpha=0.14, lw=0)
    axes.set(ylabel=_ar_label(_first_scores(runs)), ylim=(0, None))
    add_legend(axes)
    shown = dataset if dataset in published.THETA else "lmo"
    for (name, points), mark in zip(published.THETA[shown].items(), "sD", strict=True):
        below.plot(*zip(*points, strict=True), f"{mark}--", color=GREY, mfc="white", label=name)
    below.set(xlabel="upper bound of theta", ylabel="AR", ylim=(0, None))
    below.set_title(f"published, {published.DATASETS[shown]}", color=GREY)
    add_legend(below)
    caption = f"Recall if only thresholds up to a bound count, on {detections_text(runs.values())}; "
    return Figure("theta", caption + "the paper's curves below.", canvas)


@mpl.rc_context(STYLE)
def thresholds_figure(run: RunRecord) -> Figure:
    """Recall at every threshold, by metric."""
    canvas, axes = one_panel()
    labels = {"vsd": "VSD (mean over tau)", "mssd": "MSSD, theta of the diameter", "mspd": "MSPD, 100 theta px"}
    for name, recall in recall_by_threshold(run.require_scores()).items():
        x = MSPD_PX / 100 if name == "mspd" else THETAS
        axes.plot(x, recall, "o-", color=METRIC_COLOURS[name], label=labels[name])
    axes.set(xlabel="theta", ylabel="recall", ylim=(0, 1.02))
    add_legend(axes)
    return Figure("thresholds", "Recall at each threshold of correctness.", canvas)


@mpl.rc_context(STYLE)
def visibility_figure(run: RunRecord) -> Figure | None:
    """Recall by visible fraction; None if the dataset does not annotate it."""
    bins = recall_by_visibility(run.require_scores())
    if not bins:
        return None
    canvas, axes = one_panel()
    for k, (name, colour) in enumerate(METRIC_COLOURS.items()):
        values = [getattr(recall, name) for _, recall in bins.values()]
        if None not in values:
            axes.bar(np.arange(len(bins)) + (k - 1) * 0.27, values, 0.25, color=colour, label=f"AR_{name.upper()}")
    labels = [f"{100 * low:.0f} to {100 * high:.0f}\nn = {count}" for (low, high), (count, _) in bins.items()]
    axes.set_xticks(range(len(bins)), labels)
    axes.set(xlabel="visible part of the instance, %", ylabel="average recall", ylim=(0, 1.02))
    add_legend(axes)
    return Figure("visibility", "Average recalls by visible part of the instance.", canvas)


@mpl.rc_context(STYLE)
def reliability_figure(run: RunRecord) -> Figure | None:
    """Share of right poses by confidence; None for a run whose poses have none."""
    if not run.confidences:
        return None
    confidence, right = np.array([c for c, _ in run.confidences]), np.array([r for _, r in run.confidences])
    bins, (canvas, axes) = reliability_bins(confidence, right), one_panel()
    axes.plot([0, 1], [0, 1], "--", color=GREY, label="calibrated")
    x, y = [b.confidence for b in bins], [b.right for b in bins]
    axes.plot(x, y, "o-", color=METRIC_COLOURS["mssd"], label="measured")
    for b in bins:
        axes.annotate(str(b.count), (b.confidence, b.right), (0, 6), textcoords="offset points", ha="center")
    axes.set(xlabel="confidence", ylabel="share of right poses", xlim=(0, 1.02), ylim=(0, 1.08))
    add_legend(axes)
    error, auc = calibration_error(confidence, right), ranking_auc(confidence, right)
    caption = f"Confidence and truth, with numbers of poses: AUC {auc:.2f}, calibration error {error:.1%}."
    return Figure("reliability", caption, canvas)


@mpl.rc_context(STYLE)
def family_figure(family: Family) -> Figure:
    """One ablation with intervals; the paper's curve, where it has one, is below on its own axes."""
    theirs = published.ABLATIONS.get(family.axis)
    title = AXIS_TITLES.get(family.axis, family.axis)
    if theirs:
        canvas, (axes, lowest) = two_panels()
        lowest.plot(*zip(*theirs, strict=True), "s--", color=GREY, mfc="white")
        lowest.set_title("published, LM-O, Stable Diffusion", color=GREY)
        lowest.set(ylabel="AR")
    else:
        canvas, axes = one_panel()
        lowest = axes
    _plot_family(axes, family)
    lowest.set_xlabel(title)
    name = "ablation_" + family.axis.replace(".", "_")
    caption = f"{title}: {len(family.runs)} runs that differ only in {family.axis}, "
    caption += f"on {detections_text(family.runs)}."
    if family.is_flat:
        caption += " All gave the same poses and scores."
    if theirs:
        caption += " The paper's curve, on ground-truth boxes, is below."
    return Figure(name, caption, canvas)


def _plot_family(axes: Axes, family: Family) -> None:
    intervals = [ar_interval(run.require_scores()) for run in family.runs]
    means = [i.mean for i in intervals]
    x = np.array(family.values, dtype=float) if family.numeric else np.arange(len(family.values))
    marks = "o-" if family.numeric else "o"
    axes.errorbar(x, means, error_bars(intervals), fmt=marks, color=COLOURS[0], capsize=2, elinewidth=1)
    base = family.runs.index(family.base)
    axes.plot(x[base], means[base], "o", ms=9, mfc="none", mec=COLOURS[0], label="base run")
    axes.set(ylabel=_ar_label(family.base.require_scores()))
    add_legend(axes)
    if not family.numeric:
        names = [value_text(v) for v in family.values]
        rotation = 25 if max(map(len, names)) * len(names) > 40 else 0
        axes.set_xticks(x, names, rotation=rotation, ha="right" if rotation else "center")


@mpl.rc_context(STYLE)
def times_figure(runs: Mapping[str, RunRecord]) -> Figure:
    """Median seconds per target by stage, one bar per run."""
    canvas, axes = one_panel(height=max(2.2, 1.3 + 0.34 * len(runs)))
    stages = list(dict.fromkeys(stage for run in runs.values() for stage in run.times_s))
    left = np.zeros(len(runs))
    for stage, colour in zip(stages, _STAGE_COLOURS, strict=False):
        seconds = np.array([run.times_s.get(stage, 0.0) for run in runs.values()])
        axes.barh(range(len(runs)), seconds, left=left, color=colour, height=0.66, label=stage)
        left += seconds
    axes.set_yticks(range(len(runs)), [wrap_name(name) for name in runs])
    axes.invert_yaxis()
    axes.set(xlabel="median seconds per target")
    axes.grid(axis="y", visible=False)
    canvas.legend(loc="outside lower center", ncols=4, columnspacing=1.2, handlelength=1, fontsize=8)
    return Figure("times", "Time per target, by stage.", canvas)


def _first_scores(runs: Mapping[str, RunRecord]) -> Scores:
    return next(iter(runs.values())).require_scores()


def _ar_label(scores: Scores) -> str:
    return "AR" if scores.vsd is not None else "mean of AR_MSSD, AR_MSPD"
