"""rows -> tables of texts; a table is measured or published, never both; as CSV and LaTeX besides."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pipeline.items.scores import Scores
from pipeline.metrics.bootstrap import Interval, image_index, paired_interval
from pipeline.metrics.recall import instance_ar, instance_recalls
from pipeline.metrics.template_error import ACC_DEG
from pipeline.progress import format_bytes
from pipeline.report import published
from pipeline.report.families import Family, difference, is_oracle, settings
from pipeline.report.figures import ar_head, ar_interval, value_text
from pipeline.report.run_records import RunRecord

NONE = "n/a"
READINGS = ("geodesic", "direction", "vectorised")
COUNTED = ("templates", "template features", "query features", "poses")


@dataclass(frozen=True)
class Table:
    """Texts under a head. ``name`` is that of its files."""

    name: str
    caption: str
    source: Literal["measured", "published"]
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def csv(self) -> str:
        """Comma-separated, with the source in every row."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(["source", *self.head])
        writer.writerows([self.source, *row] for row in self.rows)
        return stream.getvalue()

    def latex(self) -> str:
        """A plain table environment."""
        lines = [" & ".join(map(_tex, row)) + r" \\" for row in (self.head, *self.rows)]
        columns = "l" + "r" * (len(self.head) - 1)
        body = "\n".join([lines[0], r"\hline", *lines[1:]])
        caption = _tex(f"{self.caption} ({self.source})")
        return (
            f"\\begin{{table}}\n\\centering\n\\begin{{tabular}}{{{columns}}}\n{body}\n\\end{{tabular}}\n"
            f"\\caption{{{caption}}}\n\\end{{table}}\n"
        )


def runs_table(rows: Sequence[RunRecord], base: RunRecord) -> Table:
    """Every run that ended well, the best first, and its difference to the base run, paired over images."""
    ordered = sorted(rows, key=lambda row: -ar_interval(_scores(row)).mean)
    without = _scores(base).vsd is None
    head = ("run", "AR_MSSD+MSPD" if without else "AR", "to base", "AR_VSD", "AR_MSSD", "AR_MSPD", "Acc15",
            "template error", "poses", "s/target", "cache/object")  # fmt: skip
    note = " AR_MSSD+MSPD is the mean of the two, not BOP's AR: VSD is not available." if without else ""
    caption = f"Runs; Acc15 and template error geodesic; * more than chance (95 %, paired over images).{note}"
    return Table("runs", caption, "measured", head, tuple(_run(row, base) for row in ordered))


def _run(row: RunRecord, base: RunRecord) -> tuple[str, ...]:
    scores = _scores(row)
    alike = scores if _scores(base).vsd is not None else replace(scores, vsd=None)  # the column's head is the base's
    spread = ar_interval(alike)
    recalls = instance_recalls(scores).mean(axis=0) if len(scores) else np.full(3, np.nan)
    angles = template_angles(row, "geodesic")
    ar = f"{_number(spread.mean)} ({_number(spread.low)} to {_number(spread.high)})"
    if scores.vsd is None and _scores(base).vsd is not None:
        ar = f"{NONE}; AR_MSSD+MSPD {_number(spread.mean)}"
    return (
        run_name(row, base),
        ar,
        "base" if row.id == base.id else signed(paired(row, base)),
        *map(_number, recalls),
        _number(acc15(row, "geodesic")),
        f"{angles.mean():.1f} deg" if len(angles) else NONE,
        f"{row.estimates}/{len(scores)}",
        f"{sum(row.times_s.values()):.2f}" if row.times_s else NONE,
        format_bytes(row.bytes_per_object) if row.bytes_per_object else NONE,
    )


def templates_table(methods: Sequence[tuple[str, RunRecord]]) -> Table:
    """Acc15 and the mean angle to the true view, in the three readings."""
    head = ("run", *(f"Acc15 {reading}" for reading in READINGS), *(f"error {reading}" for reading in READINGS))
    body = []
    for name, row in methods:
        angles = [template_angles(row, reading) for reading in READINGS]
        means = [f"{a.mean():.1f} deg" if len(a) else NONE for a in angles]
        body.append((name, *(_number(acc15(row, reading)) for reading in READINGS), *means))
    caption = "Template match, symmetries considered: share of all instances within 15 degrees, and mean angle."
    return Table("templates", caption, "measured", head, tuple(body))


def family_table(family: Family) -> Table:
    """The points of one ablation, and each one's paired difference to the base run."""
    body = [
        (value_text(value), *_point(row), "base" if row.id == family.base.id else signed(paired(row, family.base)))
        for value, row in zip(family.values, family.rows, strict=True)
    ]
    name = "ablation_" + family.axis.replace(".", "_")
    head = (family.axis, ar_head(_scores(family.base)), "95 %", "to base, paired")
    return Table(name, f"Runs that differ in {family.axis} alone.", "measured", head, tuple(body))


def _point(row: RunRecord) -> tuple[str, str]:
    spread = ar_interval(_scores(row))
    return _number(spread.mean), f"{_number(spread.low)} to {_number(spread.high)}"


def correspondence_table(rows: Sequence[RunRecord]) -> Table | None:
    """The paper's table "Correspondence estimation", from the runs of its variations; None without them."""
    parts = {"no_coprojection": (0, 1, 0), "no_clusters": (1, 0, 0), "no_subpixel": (1, 1, 0), "none": (1, 1, 1)}
    by_name = {row.config.get("variation", "none"): row for row in _one_method(rows, "no_subpixel")}
    if not {"no_coprojection", "no_clusters", "no_subpixel"} & set(by_name):
        return None
    body = []
    for name, switched in parts.items():
        if name in by_name:
            row = by_name[name]
            seconds = f"{sum(row.times_s.values()):.2f}"
            body.append((*("yes" if on else "no" for on in switched), *_point(row), seconds))
    recall = ar_head(_scores(by_name[next(iter(by_name))]))
    head = ("co-projection", "clusters", "sub-pixel", recall, "95 %", "s/target")
    return Table("correspondence", "Correspondence estimation.", "measured", head, tuple(body))


def ladder_table(rows: Sequence[RunRecord]) -> Table | None:
    """The oracle ladder: what each true part that is put in gains over the rung before; None without its runs."""
    rungs = {"none": "as estimated", "oracle_mask": "true mask", "oracle_template": "true mask, template",
             "oracle_correspondences": "true mask, template, correspondences"}  # fmt: skip
    by_name = {row.config.get("variation", "none"): row for row in _one_method(rows, "oracle_template")}
    shown = [(title, by_name[name]) for name, title in rungs.items() if name in by_name]
    if len(shown) < 2 or "oracle_template" not in by_name:
        return None
    body, before = [], None
    for title, row in shown:
        gain = "" if before is None else signed(paired(row, before))
        body.append((title, *_point(row), gain))
        before = row
    head = ("put in", ar_head(_scores(shown[0][1])), "95 %", "gain, paired")
    return Table("ladder", "Oracle ladder: where is the loss?", "measured", head, tuple(body))


def _one_method(rows: Sequence[RunRecord], variation: str) -> list[RunRecord]:
    """Of a variation's rows and those they can be held against, the ones of the newest such run's settings."""
    newest = next((row for row in reversed(rows) if row.config.get("variation") == variation), None)
    if newest is None:
        return []
    switched = {"fuse", "cluster", "detect", "match", "correspond"}

    def fixed(row: RunRecord) -> dict[str, object]:
        return {k: v for k, v in settings(row).items() if k.split(".")[0] not in switched}

    mine = [row for row in rows if fixed(row) == fixed(newest) and _same_metric(row, newest)]
    mine = [row for row in mine if not is_oracle(row) or row.label.get("detect", "gt_mask") == "gt_mask"]
    plain = [row for row in mine if row.config.get("variation", "none") == "none"]
    special = [row for row in mine if row.config.get("variation", "none") != "none"]
    asked = settings(newest)
    nearest = sorted(plain, key=lambda row: len(difference(asked, settings(row))))[:1]
    return [*special, *nearest]


def _same_metric(ours: RunRecord, theirs: RunRecord) -> bool:
    return (_scores(ours).vsd is None) == (_scores(theirs).vsd is None)


def improvement_table(methods: Sequence[tuple[str, RunRecord]]) -> Table | None:
    """Relative improvement of the first method over each other one; None with one method alone."""
    if len(methods) < 2:
        return None
    (our_name, ours), *others = methods
    body = []
    for name, row in others:
        error = _relative(_mean(template_angles(row, "geodesic")), _mean(template_angles(ours, "geodesic")), down=True)
        accuracy = _relative(acc15(row, "geodesic"), acc15(ours, "geodesic"))
        gain = _relative(ar_interval(_scores(row)).mean, ar_interval(_scores(ours)).mean)
        body.append((f"{our_name} over {name}", error, accuracy, gain, signed(paired(ours, row))))
    recall = ar_head(_scores(ours))
    head = ("methods", "pose error", "Acc15", recall, f"{recall} difference, paired")
    caption = "Relative improvements; pose error is the mean geodesic angle of the matched template."
    return Table("improvement", caption, "measured", head, tuple(body))


def counts_table(rows: Sequence[RunRecord], base: RunRecord) -> Table:
    """What each job computed and what it found in the cache."""
    body = [(run_name(row, base), *(_count(row, step) for step in COUNTED)) for row in rows]
    caption = "Computed + reused, by job: a sweep over matching computes no template and no feature."
    return Table("counts", caption, "measured", ("run", *COUNTED), tuple(body))


def _count(row: RunRecord, step: str) -> str:
    count = row.counts.get(step)
    return NONE if count is None else f"{count['computed']:.0f} + {count['reused']:.0f}"


def times_table(rows: Sequence[tuple[str, RunRecord]]) -> Table:
    """Median seconds of a target by stage."""
    stages = list(dict.fromkeys(stage for _, row in rows for stage in row.times_s))
    body = []
    for name, row in rows:
        seconds = [row.times_s.get(stage, 0.0) for stage in stages]
        body.append((name, *(f"{s:.4f}" for s in seconds), f"{sum(seconds):.3f}"))
    return Table("times", "Median seconds of a target by stage.", "measured", ("run", *stages, "all"), tuple(body))


def failures_table(rows: Sequence[RunRecord], base: RunRecord) -> Table | None:
    """Why targets have no pose, by run; None where all have one."""
    body = [(run_name(row, base), stage, reason, str(count)) for row in rows for stage, reason, count in row.failures]
    head = ("run", "stage", "reason", "targets")
    return Table("failures", "Targets without a pose.", "measured", head, tuple(body)) if body else None


def published_tables() -> list[Table]:
    """The paper's tables."""
    methods = tuple((m.name, m.training, *(f"{m.ar[d]:.3f}" for d in published.DATASETS)) for m in published.METHODS)
    yes = {True: "yes", False: "no"}
    parts = tuple(
        (yes[c.co_projection], yes[c.clusters], yes[c.sub_pixel], f"{c.ar:.3f}", f"{c.time_s:.2f}")
        for c in published.CORRESPONDENCE
    )
    gains = tuple(
        (published.DATASETS[d], *(f"{v:+.2f} %" for v in values)) for d, values in published.IMPROVEMENT.items()
    )
    return [
        Table("published_methods", "AR of single-shot methods.", "published",
              ("method", "training", *published.DATASETS.values()), methods),
        Table("published_correspondence", "Correspondence estimation, LM-O, RTX 4070.", "published",
              ("co-projection", "clusters", "sub-pixel", "AR", "s"), parts),
        Table("published_improvement", "Relative improvement of DZOP over ZS6D.", "published",
              ("dataset", "pose error", "Acc15", "AR"), gains),
    ]  # fmt: skip


def published_column(dataset: str) -> Table | None:
    """The paper's AR of every method on one dataset; None where the paper does not have it."""
    if dataset not in published.DATASETS:
        return None
    methods = tuple((m.name, m.training, f"{m.ar[dataset]:.3f}") for m in published.METHODS)
    name = published.DATASETS[dataset]
    return Table(f"published_{dataset}", f"AR of single-shot methods on {name}, the paper's data and detections.",
                 "published", ("method", "training", "AR"), methods)  # fmt: skip


def run_name(row: RunRecord, base: RunRecord) -> str:
    """What sets a run apart from the base run; the method's name where that is another."""
    if row.id == base.id or not row.config:
        return row.method
    variation = row.config.get("variation", "none")
    changed = difference(settings(base), settings(row))
    if variation not in ("none", base.config.get("variation", "none")):
        parts = ("fuse", "cluster", "correspond", "match", "detect")  # what variations set
        rest = [f"{k}={value_text(v)}" for k, v in changed.items() if k.split(".")[0] not in parts]
        return " ".join([variation.replace("_", " "), *([] if row.method == base.method else [row.method]), *rest])
    bound = (row.config.get("evaluate") or {}).get("theta_max", 0.5)
    told = [f"{name}={value_text(value)}" for name, value in changed.items()]
    told += [f"theta_max={bound:g}"] if bound != 0.5 else []
    return " ".join(([] if row.method == base.method and told else [row.method]) + told)


def paired(ours: RunRecord, theirs: RunRecord) -> Interval | None:
    """The difference of two runs, paired over images; None for other instances."""
    a, b = _scores(ours), _scores(theirs)
    if a.instances() != b.instances() or (a.vsd is None) != (b.vsd is None):
        return None
    return paired_interval(instance_ar(a), instance_ar(b), image_index(a.scene_id, a.im_id))


def signed(value: Interval | None) -> str:
    """A difference with its interval, and a star when it is more than chance."""
    if value is None:
        return NONE
    star = " *" if value.excludes_zero else ""
    return f"{value.mean:+.3f} ({value.low:+.3f} to {value.high:+.3f}){star}"


def template_angles(row: RunRecord, reading: str) -> np.ndarray:
    """Angles of the instances that had a template matched, degrees."""
    return np.array([getattr(error, reading) for error in row.templates.values()])


def acc15(row: RunRecord, reading: str) -> float:
    """Share of all instances whose template lies within 15 degrees; NaN where no template is known."""
    angles = template_angles(row, reading)
    return float((angles < ACC_DEG).sum() / max(len(_scores(row)), 1)) if len(angles) else float("nan")


def _scores(row: RunRecord) -> Scores:
    assert row.scores is not None
    return row.scores


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _relative(before: float, after: float, *, down: bool = False) -> str:
    if not (np.isfinite(before) and np.isfinite(after)) or before == 0:
        return NONE
    gain = (before - after) / before if down else (after - before) / before
    return f"{gain:+.1%}"


def _number(value: float) -> str:
    return f"{value:.3f}" if np.isfinite(value) else NONE


def _tex(text: str) -> str:
    special = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    return "".join(special.get(c, f"\\{c}" if c in "&%$#_{}" else c) for c in text)
