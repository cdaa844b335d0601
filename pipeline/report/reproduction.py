"""Run records -> the paper's tables and curves with published and measured values in columns side by side.

Only runs on the paper's terms appear: its datasets, Stable Diffusion's features, a detector's masks for the table of
methods and ground-truth boxes for the ablations. A part of a dataset is named as such.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pipeline.report import published
from pipeline.report.families import base_of, difference, settings
from pipeline.report.run_records import RunRecord
from pipeline.report.run_statistics import ar_interval
from pipeline.report.table import NOT_AVAILABLE, Table
from pipeline.report.tables import number_text, range_text
from pipeline.report.variation_tables import PARTS, runs_by_variation

OURS = ("dzop_paper", "dzop_sd", "dzop")  # published as DZOP, with Stable Diffusion's features
OTHERS = {"zs6d": "ZS6D", "foundpose": "FoundPose"}
ABLATED = "lmo"
INSTANCES = {"lmo": 1445, "ycbv": 4123, "tless": 6423}  # of all targets of the BOP test sets


def reproduction_tables(runs: Sequence[RunRecord]) -> list[Table]:
    """The tables for which there are runs: methods, correspondence estimation, and each swept parameter."""
    done = [run for run in runs if run.status == "done" and run.scores is not None and run.dataset is not None]
    on_boxes = [run for run in done if _dataset(run) == ABLATED and _is_ours(run) and _detections(run) == "gt_bbox"]
    found = [_methods(done), _correspondence(on_boxes), *(_ablation(on_boxes, axis) for axis in published.ABLATIONS)]
    return [table for table in found if table is not None]


def _methods(runs: Sequence[RunRecord]) -> Table | None:
    """Published methods with a measured run on a detector's masks, by dataset."""
    rows = []
    for dataset in published.DATASETS:
        masked = [run for run in runs if _dataset(run) == dataset and _detections(run) == "json" and _is_plain(run)]
        for method in published.METHODS:
            mine = [run for run in masked if _published_name(run) == method.name]
            if mine:
                run = max(mine, key=lambda run: (len(run.require_scores()), run.at))
                title = f"{published.DATASETS[dataset]}: {method.name}"
                rows.append((title, f"{method.ar[dataset]:.3f}", *_format_measured(run), run.method, _share(run)))
    head = ("dataset and method", "published AR", "measured AR", "95 %", "measured with", "instances")
    caption = "Comparison of methods: the paper's AR, and ours on a detector's masks."
    return Table("reproduction_methods", caption, "both", head, tuple(rows)) if rows else None


def _correspondence(runs: Sequence[RunRecord]) -> Table | None:
    """The four lines of the table "Correspondence estimation"."""
    by_name = runs_by_variation(runs, "no_subpixel")
    if not {"no_coprojection", "no_clusters", "no_subpixel"} & set(by_name):
        return None
    rows = []
    for line, (name, parts) in zip(published.CORRESPONDENCE, PARTS.items(), strict=True):
        assert parts == (line.co_projection, line.clusters, line.sub_pixel)
        run = by_name.get(name)
        measured = (NOT_AVAILABLE, NOT_AVAILABLE) if run is None else _format_measured(run)
        seconds = NOT_AVAILABLE if run is None else f"{sum(run.times_s.values()):.2f}"
        shown = ", ".join(("co-projection",) * parts[0] + ("clusters",) * parts[1] + ("sub-pixel",) * parts[2])
        rows.append((shown, f"{line.ar:.3f}", *measured, f"{line.time_s:.2f}", seconds))
    head = ("parts that are on", "published AR", "measured AR", "95 %", "published s (RTX 4070)", "measured s/target")
    caption = (
        f"Correspondence estimation on LM-O's ground-truth boxes, {_share(next(iter(by_name.values())))} instances."
    )
    return Table("reproduction_correspondence", caption, "both", head, tuple(rows))


def _ablation(runs: Sequence[RunRecord], axis: str) -> Table | None:
    """The points of one of the paper's curves that were run; None with fewer than two."""
    plain = [run for run in runs if _is_plain(run)]
    if not plain:
        return None
    base = base_of(plain)
    rows = []
    for value, recall in published.ABLATIONS[axis]:
        run = next((run for run in reversed(plain) if _is_point(run, base, axis, value)), None)
        if run is not None:
            rows.append((f"{value:g}", f"{recall:.4f}", *_format_measured(run)))
    head = (axis, "published AR", "measured AR", "95 %")
    caption = f"{axis} on LM-O's ground-truth boxes, {_share(base)} instances."
    name = "reproduction_" + axis.replace(".", "_")
    return Table(name, caption, "both", head, tuple(rows)) if len(rows) > 1 else None


def _is_point(run: RunRecord, base: RunRecord, axis: str, value: float) -> bool:
    """Whether a run differs from the base run in nothing but ``axis``, which has this value."""
    ours = settings(run)
    return ours.get(axis) == value and set(difference(settings(base), ours)) <= {axis}


def _format_measured(run: RunRecord) -> tuple[str, str]:
    """AR and its interval; without depth images the mean of the other two recalls, named as such."""
    scores = run.require_scores()
    interval = ar_interval(scores)
    name = "" if scores.vsd is not None else "AR_MSSD+MSPD "
    return name + number_text(interval.mean), range_text(interval)


def _share(run: RunRecord) -> str:
    count, total = len(run.require_scores()), INSTANCES.get(_dataset(run), 0)
    return f"{count}" if count == total else f"{count} of {total}"


def _published_name(run: RunRecord) -> str:
    return "DZOP" if _is_ours(run) else OTHERS.get(str(run.config.get("method")), "")


def _is_ours(run: RunRecord) -> bool:
    return run.config.get("method") in OURS and _variant(run, "extract") == "stable_diffusion"


def _is_plain(run: RunRecord) -> bool:
    return run.config.get("variation", "none") == "none"


def _dataset(run: RunRecord) -> str:
    return run.dataset.name if run.dataset else ""


def _detections(run: RunRecord) -> str:
    return _variant(run, "detect")


def _variant(run: RunRecord, stage: str) -> str:
    """The variant of a stage: the module that its ``_target_`` names."""
    group: Any = run.config.get(stage)
    target = group.get("_target_", "") if isinstance(group, dict) else ""
    return str(target).split(".")[-2] if "." in str(target) else ""
