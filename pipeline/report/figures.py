"""rows -> figures. Measured is solid and filled; published is grey, dashed and hollow, on axes of its own."""

from __future__ import annotations

import io
import logging
import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Canvas

from pipeline.items.scores import Scores
from pipeline.metrics.bootstrap import Interval, image_index, mean_interval
from pipeline.metrics.recall import MSPD_PX, THETAS, instance_ar, recall_by_threshold, recall_by_visibility
from pipeline.report import published
from pipeline.report.families import Family
from pipeline.report.run_records import RunRecord

logging.getLogger("fontTools").setLevel(logging.WARNING)  # it tells every glyph that a PDF holds

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#999933")
GREY = "#8a8f98"
OF_METRIC = {"vsd": COLOURS[0], "mssd": COLOURS[1], "mspd": COLOURS[2]}
SIZE = (4.6, 3.1)  # inches
MOST_BARS = 36  # in one figure; more cannot be told apart on a phone
STYLE: Any = {
    "font.size": 9,
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "svg.fonttype": "none",
    "svg.hashsalt": "dzop",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#c3c7cd",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#eceef1",
    "axes.labelcolor": "#40464f",
    "xtick.color": "#40464f",
    "ytick.color": "#40464f",
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "legend.fontsize": 8,
    "lines.linewidth": 1.6,
    "lines.markersize": 4.5,
    "pdf.fonttype": 42,
}
TITLES = {
    "cluster.count": "Clusters a side",
    "fuse.dim": "Dimension of the co-projection",
    "correspond.per_cluster": "Correspondences per cluster",
    "extract.timestep": "Timestep",
    "extract.hook": 'What "layer k" is taken from',
    "extract.input_size": "Input size, px",
    "extract.noise": "Noise",
    "extract.ensemble": "Noises averaged",
    "match.layer": "Layer templates are matched by",
    "match.top_k": "Templates kept",
    "fuse.layers": "Layers of the hyperfeature",
    "render.viewpoints": "Viewpoints",
    "render.count": "Number of templates",
    "correspond.kernel": "Side of the sub-pixel neighbourhood, cells",
    "solve": "Solver",
    "choose": "What decides between templates",
    "refine": "Refinement",
    "extract": "Features",
    "match": "Template match",
}


@dataclass(frozen=True, eq=False)
class Figure:
    """A drawn figure: a name for files, a caption, and what a person who cannot see it is told."""

    name: str
    caption: str
    canvas: Canvas

    def svg(self) -> str:
        """The figure as an SVG element that fills the width it is given; the same figure gives the same text."""
        stream = io.StringIO()
        with mpl.rc_context(STYLE):
            self.canvas.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
        text = stream.getvalue()
        text = re.sub(r'\s(width|height)="[\d.]+pt"', "", text[text.index("<svg") :], count=2)
        text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
        # matplotlib numbers its groups anew in every figure; nothing refers to them
        text = re.sub(r' id="[a-z_]+\d*_\d+"', "", text)
        return re.sub(r"\n\s*", "\n", text)

    def save(self, stem: str) -> None:
        """PNG and PDF beside one another."""
        with mpl.rc_context(STYLE):
            self.canvas.savefig(f"{stem}.png", dpi=160)
            self.canvas.savefig(f"{stem}.pdf", metadata={"CreationDate": None})


def ar_interval(scores: Scores, *, theta_max: float = 0.5) -> Interval:
    """Mean recall over instances (AR where VSD is available) with its interval over images."""
    return mean_interval(instance_ar(scores, theta_max=theta_max), image_index(scores.scene_id, scores.im_id))


def ar_name(scores: Scores) -> str:
    """What the mean recall of these scores may be called."""
    return "mean of AR_MSSD and AR_MSPD" if scores.vsd is None else "AR"


def ar_head(scores: Scores) -> str:
    """The same as the head of a table's column."""
    return "AR_MSSD+MSPD" if scores.vsd is None else "AR"


@mpl.rc_context(STYLE)
def objects_figures(rows: Mapping[str, RunRecord], dataset: str) -> list[Figure]:
    """Bars of each object's recall for some runs, a few objects a figure; the paper's beside them where it has them."""
    objects = np.unique(_scores(next(iter(rows.values()))).obj_id)
    bars = len(rows) + len(published.OBJECTS.get(dataset, {}))
    parts = np.array_split(objects, -(-len(objects) * bars // MOST_BARS)) if len(objects) else [objects]
    return [_objects_figure(rows, dataset, part.tolist()) for part in parts if len(part) or len(parts) == 1]


def _objects_figure(rows: Mapping[str, RunRecord], dataset: str, objects: Sequence[int]) -> Figure:
    first = _scores(next(iter(rows.values())))
    theirs = published.OBJECTS.get(dataset, {})
    canvas, axes = _canvas()
    bars = len(rows) + len(theirs)
    width = 0.8 / bars
    for k, (name, row) in enumerate(rows.items()):
        scores = _scores(row)
        spread = [ar_interval(scores.select(scores.obj_id == obj_id)) for obj_id in objects]
        place = np.arange(len(objects)) + (k - (bars - 1) / 2) * width
        axes.bar(place, [i.mean for i in spread], width * 0.92, color=COLOURS[k % len(COLOURS)], label=_wrapped(name))
        axes.errorbar(place, [i.mean for i in spread], _whiskers(spread), fmt="none", ecolor="#40464f", elinewidth=0.8)
    for k, (name, values) in enumerate(theirs.items(), start=len(rows)):
        place = np.arange(len(objects)) + (k - (bars - 1) / 2) * width
        heights = [values.get(obj_id, np.nan) for obj_id in objects]
        told = f"{name}, published AR"
        axes.bar(place, heights, width * 0.92, fill=False, edgecolor=GREY, linestyle="--", label=told)
    axes.set_xticks(range(len(objects)), [str(obj_id) for obj_id in objects])
    axes.set(xlabel="object", ylabel=_short(first), ylim=(0, 1.02))
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, columnspacing=1.2, handlelength=1.4, borderpad=0)
    of = f"objects {objects[0]} to {objects[-1]}" if len(objects) > 1 else "object"
    return Figure("objects", f"{ar_name(first)}, {of}, with 95 % intervals over images.", canvas)


@mpl.rc_context(STYLE)
def theta_figure(rows: Mapping[str, RunRecord], dataset: str) -> Figure:
    """Recall over the upper bound of theta, measured above, published below."""
    shown = dataset if dataset in published.THETA else "lmo"
    canvas, (axes, theirs) = _two_panels()
    for k, (name, row) in enumerate(rows.items()):
        spread = [ar_interval(_scores(row), theta_max=float(bound)) for bound in THETAS]
        colour = COLOURS[k % len(COLOURS)]
        axes.plot(THETAS, [i.mean for i in spread], "o-", color=colour, label=_wrapped(name))
        axes.fill_between(THETAS, [i.low for i in spread], [i.high for i in spread], color=colour, alpha=0.14, lw=0)
    axes.set(ylabel=_short(_scores(next(iter(rows.values())))), ylim=(0, None))
    _legend(axes)
    for (name, points), mark in zip(published.THETA[shown].items(), "sD", strict=True):
        theirs.plot(*zip(*points, strict=True), f"{mark}--", color=GREY, mfc="white", label=name)
    theirs.set(xlabel="upper bound of theta", ylabel="AR", ylim=(0, None))
    theirs.set_title(f"published, {published.DATASETS[shown]}", color=GREY)
    _legend(theirs)
    return Figure("theta", "Recall when only thresholds up to a bound count; below, the paper's curves.", canvas)


@mpl.rc_context(STYLE)
def thresholds_figure(row: RunRecord) -> Figure:
    """Recall at every threshold, by metric."""
    canvas, axes = _canvas()
    names = {"vsd": "VSD (mean over tau)", "mssd": "MSSD, theta of the diameter", "mspd": "MSPD, 100 theta px"}
    for name, recall in recall_by_threshold(_scores(row)).items():
        axes.plot(THETAS if name != "mspd" else MSPD_PX / 100, recall, "o-", color=OF_METRIC[name], label=names[name])
    axes.set(xlabel="theta", ylabel="recall", ylim=(0, 1.02))
    _legend(axes)
    return Figure("thresholds", "Recall at each threshold of correctness.", canvas)


@mpl.rc_context(STYLE)
def visibility_figure(row: RunRecord) -> Figure | None:
    """Recall by visible fraction; None where the dataset does not say it."""
    scores = _scores(row)
    bins = recall_by_visibility(scores)
    if not bins:
        return None
    canvas, axes = _canvas()
    for k, (name, colour) in enumerate(OF_METRIC.items()):
        values = [getattr(recall, name) for _, recall in bins.values()]
        if None not in values:
            axes.bar(np.arange(len(bins)) + (k - 1) * 0.27, values, 0.25, color=colour, label=f"AR_{name.upper()}")
    labels = [f"{100 * low:.0f} to {100 * high:.0f}\nn = {count}" for (low, high), (count, _) in bins.items()]
    axes.set_xticks(range(len(bins)), labels)
    axes.set(xlabel="visible part of the instance, %", ylabel="average recall", ylim=(0, 1.02))
    _legend(axes)
    return Figure("visibility", "Average recalls by how much of an instance is visible.", canvas)


@mpl.rc_context(STYLE)
def family_figure(family: Family) -> Figure:
    """One ablation with its intervals; the paper's curve below it, on axes of its own."""
    theirs = published.ABLATIONS.get(family.axis)
    canvas, panels = _two_panels() if theirs else _canvas()
    axes, below = panels if theirs else (panels, None)
    spread = [ar_interval(_scores(row)) for row in family.rows]
    place = np.array(family.values, dtype=float) if family.numeric else np.arange(len(family.values))
    style = "o-" if family.numeric else "o"
    axes.errorbar(
        place, [i.mean for i in spread], _whiskers(spread), fmt=style, color=COLOURS[0], capsize=2, elinewidth=1
    )
    at = family.rows.index(family.base)
    axes.plot(place[at], spread[at].mean, "o", ms=9, mfc="none", mec=COLOURS[0], label="base run")
    axes.set(ylabel=_short(_scores(family.base)))
    _legend(axes)
    title = TITLES.get(family.axis, family.axis)
    lowest = axes
    if below is not None and theirs:
        below.plot(*zip(*theirs, strict=True), "s--", color=GREY, mfc="white")
        below.set_title("published, LM-O, Stable Diffusion", color=GREY)
        below.set(ylabel="AR")
        lowest = below
    if not family.numeric:
        names = [value_text(v) for v in family.values]
        turned = 25 if max(map(len, names)) * len(names) > 40 else 0
        axes.set_xticks(place, names, rotation=turned, ha="right" if turned else "center")
    lowest.set_xlabel(title)
    name = "ablation_" + family.axis.replace(".", "_")
    return Figure(name, f"{title}: {len(family.rows)} runs that differ in {family.axis} alone.", canvas)


@mpl.rc_context(STYLE)
def times_figure(rows: Mapping[str, RunRecord]) -> Figure:
    """Median seconds of a target by stage, one bar a run."""
    canvas, axes = _canvas(height=max(2.2, 1.3 + 0.34 * len(rows)))
    stages = list(dict.fromkeys(stage for row in rows.values() for stage in row.times_s))
    left = np.zeros(len(rows))
    for stage, colour in zip(stages, (*COLOURS, GREY, "#b8bcc4", "#6b4c9a"), strict=False):
        seconds = np.array([row.times_s.get(stage, 0.0) for row in rows.values()])
        axes.barh(range(len(rows)), seconds, left=left, color=colour, height=0.66, label=stage)
        left += seconds
    axes.set_yticks(range(len(rows)), [_wrapped(name) for name in rows])
    axes.invert_yaxis()
    axes.set(xlabel="median seconds of a target")
    axes.grid(axis="y", visible=False)
    canvas.legend(loc="outside lower center", ncols=4, columnspacing=1.2, handlelength=1, fontsize=8)
    return Figure("times", "Where the time of a target goes, by stage.", canvas)


def value_text(value: Any) -> str:
    """A setting's value as a person writes it."""
    if isinstance(value, tuple):
        return ", ".join(map(str, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def _wrapped(name: str) -> str:
    """A run's name in lines that leave the axes their room; a page's tables have it whole."""
    lines = textwrap.wrap(name, 26)
    return "\n".join(lines if len(lines) <= 3 else [*lines[:2], f"{lines[2]} ..."])


def _scores(row: RunRecord) -> Scores:
    assert row.scores is not None
    return row.scores


def _short(scores: Scores) -> str:
    return "AR" if scores.vsd is not None else "mean of AR_MSSD, AR_MSPD"


def _whiskers(spread: Sequence[Interval]) -> np.ndarray:
    return np.array([[max(i.mean - i.low, 0), max(i.high - i.mean, 0)] for i in spread]).T


def _canvas(*, height: float = SIZE[1]) -> tuple[Canvas, Any]:
    canvas = Canvas(figsize=(SIZE[0], height), layout="constrained")
    FigureCanvasAgg(canvas)
    return canvas, canvas.subplots()


def _two_panels() -> tuple[Canvas, Any]:
    canvas = Canvas(figsize=(SIZE[0], SIZE[1] + 1.2), layout="constrained")
    FigureCanvasAgg(canvas)
    return canvas, canvas.subplots(2, 1, sharex=True, height_ratios=(1.6, 1))


def _legend(axes: Axes) -> None:
    if axes.get_legend_handles_labels()[0]:
        axes.legend()
