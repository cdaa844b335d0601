"""Runs of conf/variation -> the paper's table of switched-off parts, and the oracle ladder."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.report.families import difference, is_oracle, settings
from pipeline.report.names import detections_text
from pipeline.report.run_records import RunRecord
from pipeline.report.run_statistics import ar_column, paired_difference, same_metric
from pipeline.report.table import Table
from pipeline.report.tables import recall_cells, signed_text

# variation -> whether co-projection, clusters and sub-pixel positions are on
PARTS = {"no_coprojection": (0, 1, 0), "no_clusters": (1, 0, 0), "no_subpixel": (1, 1, 0), "none": (1, 1, 1)}
_LADDER = {
    "none": "as estimated",
    "oracle_mask": "true mask",
    "oracle_choice": "true mask, choice of the hypothesis",
    "oracle_template": "true mask, template",
    "oracle_correspondences": "true mask, template, correspondences",
}
_SET_BY_VARIATIONS = {"fuse", "cluster", "detect", "match", "correspond", "choose"}


def correspondence_table(runs: Sequence[RunRecord]) -> Table | None:
    """The paper's table "Correspondence estimation" from runs of its variations; None if there are none."""
    by_name = runs_by_variation(runs, "no_subpixel")
    if not {"no_coprojection", "no_clusters", "no_subpixel"} & set(by_name):
        return None
    rows = []
    for name, parts in PARTS.items():
        if name in by_name:
            run = by_name[name]
            seconds = f"{sum(run.times_s.values()):.2f}"
            rows.append((*("yes" if on else "no" for on in parts), *recall_cells(run), seconds))
    recall = ar_column(next(iter(by_name.values())).require_scores())
    head = ("co-projection", "clusters", "sub-pixel", recall, "95 %", "s/target")
    caption = f"Correspondence estimation on {detections_text(by_name.values())}."
    return Table("correspondence", caption, "measured", head, tuple(rows))


def ladder_table(runs: Sequence[RunRecord]) -> Table | None:
    """The oracle ladder: the gain of each further part replaced by ground truth; None without such runs."""
    by_name = runs_by_variation(runs, "oracle_template")
    shown = [(title, by_name[name]) for name, title in _LADDER.items() if name in by_name]
    if len(shown) < 2 or "oracle_template" not in by_name:
        return None
    rows, before = [], None
    for title, run in shown:
        gain = "" if before is None else signed_text(paired_difference(run, before))
        rows.append((title, *recall_cells(run), gain))
        before = run
    head = ("ground truth", ar_column(shown[0][1].require_scores()), "95 %", "gain, paired")
    caption = "Oracle ladder: recall as parts of the pipeline are replaced by ground truth. "
    caption += f"The first line is on {detections_text([shown[0][1]])}."
    return Table("ladder", caption, "measured", head, tuple(rows))


def _variation(run: RunRecord) -> str:
    return run.config.get("variation", "none")


def runs_by_variation(runs: Sequence[RunRecord], variation: str) -> dict[str, RunRecord]:
    """Runs by variation that agree with the newest run of ``variation`` in every setting that variations leave alone.

    "none" is the unvaried run with the fewest other settings.
    """
    newest = next((run for run in reversed(runs) if _variation(run) == variation), None)
    if newest is None:
        return {}

    def fixed(run: RunRecord) -> dict[str, object]:
        return {k: v for k, v in settings(run).items() if k.split(".")[0] not in _SET_BY_VARIATIONS}

    alike = [run for run in runs if fixed(run) == fixed(newest) and same_metric(run, newest)]
    alike = [run for run in alike if not is_oracle(run) or run.label.get("detect", "gt_mask") == "gt_mask"]
    varied = [run for run in alike if _variation(run) != "none"]
    unvaried = [run for run in alike if _variation(run) == "none"]
    nearest = sorted(unvaried, key=lambda run: len(difference(settings(newest), settings(run))))[:1]
    return {_variation(run): run for run in [*varied, *nearest]}
