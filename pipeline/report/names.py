"""Names of runs, settings and swept axes, as they appear in tables and figures."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from pipeline.report.families import difference, settings
from pipeline.report.run_records import RunRecord

AXIS_TITLES = {
    "cluster.count": "Clusters per crop",
    "fuse.dim": "Dimension of the co-projection",
    "correspond.per_cluster": "Correspondences per cluster",
    "extract.timestep": "Timestep",
    "extract.hook": 'Where "layer k" is read',
    "extract.input_size": "Input size, px",
    "extract.noise": "Noise",
    "extract.ensemble": "Noise samples averaged",
    "match.layer": "Layer used for template matching",
    "match.top_k": "Templates kept",
    "fuse.layers": "Layers of the hyperfeature",
    "render.viewpoints": "Viewpoints",
    "render.count": "Number of templates",
    "correspond.kernel": "Side of the sub-pixel neighbourhood, cells",
    "solve": "Solver",
    "choose": "Scoring of hypotheses",
    "refine": "Refinement",
    "extract": "Features",
    "match": "Template match",
}
_SET_BY_VARIATIONS = ("fuse", "cluster", "correspond", "match", "detect")


def run_name(run: RunRecord, base: RunRecord) -> str:
    """The settings in which a run differs from the base run; its method's name if that differs or nothing does."""
    if run.id == base.id or not run.config:
        return run.method
    variation = run.config.get("variation", "none")
    changed = difference(settings(base), settings(run))
    method = [] if run.method == base.method else [run.method]
    if variation not in ("none", base.config.get("variation", "none")):
        rest = [f"{k}={value_text(v)}" for k, v in changed.items() if k.split(".")[0] not in _SET_BY_VARIATIONS]
        return " ".join([variation.replace("_", " "), *method, *rest])
    parts = [f"{name}={value_text(value)}" for name, value in changed.items()]
    theta_max = (run.config.get("evaluate") or {}).get("theta_max", 0.5)
    if theta_max != 0.5:
        parts.append(f"theta_max={theta_max:g}")
    return " ".join([*(method if parts else [run.method]), *parts])


def detections_text(runs: Iterable[RunRecord]) -> str:
    """What the runs' detections are, each kind once, with the mark of an oracle where they are ground truth."""
    return "; ".join(dict.fromkeys(map(_detections_of, runs)))


def _detections_of(run: RunRecord) -> str:
    if run.detections:
        return run.detections
    variant = str((run.config.get("detect") or {}).get("_target_", "unknown detections")).rsplit(".", 2)
    name = variant[-2] if len(variant) > 1 else variant[0]
    return f"{name} (oracle)" if name.startswith("gt_") else name  # a record of an earlier version


def value_text(value: Any) -> str:
    """A setting's value without brackets and trailing zeros."""
    if isinstance(value, tuple):
        return ", ".join(map(str, value))
    return f"{value:g}" if isinstance(value, float) else str(value)
