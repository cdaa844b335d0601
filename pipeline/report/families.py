"""Run records -> families of runs that differ from one base run in a single setting: the curves of ablations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.report.run_records import NOT_IDENTIFYING, RunRecord

# groups that do not change scores: records hold every threshold, and the runs of a section share their targets
_SAME_SCORES = {"evaluate", "dataset", "select", "method", "variation", "confidence"}
# exceptions within these groups: fields that decide which meshes are rendered and how poses are scored
_MESHES = {"dataset": ("models",), "evaluate": ("models", "vsd_delta_mm")}
MAX_FAMILIES = 24


@dataclass(frozen=True, eq=False)
class Family:
    """Runs that differ only in ``axis``, sorted by its value.

    ``axis`` is a field ("cluster.count") or, for another variant of a stage, the stage ("solve").
    """

    axis: str
    base: RunRecord
    runs: tuple[RunRecord, ...]
    values: tuple[Any, ...]

    @property
    def is_flat(self) -> bool:
        """Whether all runs gave the same answers: the axis changes nothing. False for records of earlier versions."""
        return len(self.runs) > 1 and len({run.answers for run in self.runs}) == 1 and bool(self.base.answers)

    @property
    def numeric(self) -> bool:
        """Whether the values are numbers, and so can be placed on a line."""
        return all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in self.values)


def settings(run: RunRecord) -> dict[str, Any]:
    """The settings that results depend on, by dotted field; a stage's variant is under the stage's name."""
    found: dict[str, Any] = {}
    for name, value in run.config.items():
        if name in NOT_IDENTIFYING or name in _SAME_SCORES:
            continue
        found |= _flatten(name, value)
    for name, fields in _MESHES.items():
        group = run.config.get(name) or {}
        found |= {f"{name}.{field}": group[field] for field in fields if field in group}
    return found


def scoring_settings(run: RunRecord) -> dict[str, Any]:
    """Settings of the scoring; runs that differ in them cannot be compared."""
    return {name: value for name, value in settings(run).items() if name.startswith("evaluate.")}


def difference(ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of ``theirs`` that differ from ``ours``; another variant counts as one, without its fields."""
    changed = {name for name in {*ours, *theirs} if ours.get(name) != theirs.get(name)}
    return {name: theirs.get(name) for name in sorted(changed) if not any(name.startswith(f"{c}.") for c in changed)}


def base_of(runs: Sequence[RunRecord]) -> RunRecord:
    """The run from which most others differ in one setting; ties go to runs outside sweeps, then to the first.

    Runs with an oracle or with parts switched off are considered only if there are no others.
    """
    runs = [run for run in runs if is_plain(run)] or runs
    all_settings = [settings(run) for run in runs]
    neighbours = [sum(len(difference(ours, theirs)) == 1 for theirs in all_settings) for ours in all_settings]
    return runs[max(range(len(runs)), key=lambda i: (neighbours[i], bool(runs[i].config), not runs[i].sweep, -i))]


def is_oracle(run: RunRecord) -> bool:
    """Whether any stage of a run used ground truth."""
    return "oracle" in run.label.values() or "extract.coordinates." in str(run.config.get("extract"))


def is_plain(run: RunRecord) -> bool:
    """Whether a run is the method as configured: no oracle, no part switched off by a variation."""
    return not is_oracle(run) and run.config.get("variation", "none") == "none"


def families(runs: Sequence[RunRecord]) -> list[Family]:
    """All families among the runs of one dataset, the base with most neighbours first.

    Oracles and variations are left out.
    """
    left = [run for run in runs if run.config and is_plain(run)]
    left = list({str(settings(run)): run for run in reversed(left)}.values())[::-1]
    found: list[Family] = []
    while len(left) > 1 and len(found) < MAX_FAMILIES:
        base = base_of(left)
        of_base = _families_of_base(base, left)
        if not of_base:
            break
        found += of_base
        taken = {run.id for family in of_base for run in family.runs}
        left = [run for run in left if run.id not in taken]
    return found[:MAX_FAMILIES]


def _families_of_base(base: RunRecord, runs: Sequence[RunRecord]) -> list[Family]:
    by_axis: dict[str, list[tuple[RunRecord, Any]]] = {}
    for run in runs:
        changed = difference(settings(base), settings(run))
        if len(changed) == 1:
            ((axis, value),) = changed.items()
            by_axis.setdefault(axis, []).append((run, value))
    found = []
    for axis, members in sorted(by_axis.items(), key=lambda item: -len(item[1])):
        members.append((base, settings(base).get(axis)))
        ordered = sorted(members, key=lambda member: _sort_key(member[1]))
        found.append(Family(axis, base, tuple(r for r, _ in ordered), tuple(v for _, v in ordered)))
    return found


def _sort_key(value: Any) -> tuple[int, float, str]:
    """Numbers by size, then everything else by its text."""
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return (0, float(value), "") if is_number else (1, 0.0, str(value))


def _flatten(name: str, value: Any) -> dict[str, Any]:
    """A variant as its name plus its fields (and nested variants) under dotted names; any other value unchanged."""
    if not (isinstance(value, Mapping) and "_target_" in value):
        return {name: _hashable(value)}
    found = {name: value["_target_"].rsplit(".", 2)[-2]}
    for field, inner in value.items():
        found |= _flatten(f"{name}.{field}", inner) if field != "_target_" else {}
    return found


def _hashable(value: Any) -> Any:
    return tuple(_hashable(v) for v in value) if isinstance(value, (list, tuple)) else value
