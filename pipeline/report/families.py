"""rows -> families that differ from one base run in one thing each: the curves of ablations, whoever ran them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.report.run_records import NOT_IDENTIFYING, RunRecord

# the scores of a row hold all thresholds; rows of one section share their targets
_SAME_SCORES = {"evaluate", "dataset", "select", "method", "variation"}
# but of these groups, what decides which meshes are rendered and which scores come out
_MESHES = {"dataset": ("models",), "evaluate": ("models", "vsd_delta_mm")}
MOST_FAMILIES = 24


@dataclass(frozen=True, eq=False)
class Family:
    """Runs that differ in ``axis`` alone ("cluster.count", or "solve" for another variant), in the order of it."""

    axis: str
    base: RunRecord
    rows: tuple[RunRecord, ...]
    values: tuple[Any, ...]

    @property
    def numeric(self) -> bool:
        """Whether the values have a place on a line."""
        return all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in self.values)


def settings(row: RunRecord) -> dict[str, Any]:
    """What a row's answers depend on, by dotted field; the variant of a stage under the stage's own name."""
    found: dict[str, Any] = {}
    for name, value in row.config.items():
        if name in NOT_IDENTIFYING or name in _SAME_SCORES:
            continue
        found |= _flat(name, value)
    for name, fields in _MESHES.items():
        group = row.config.get(name) or {}
        found |= {f"{name}.{field}": group[field] for field in fields if field in group}
    return found


def scored_by(row: RunRecord) -> dict[str, Any]:
    """What poses were held against: two runs that differ in it were not scored alike."""
    return {name: value for name, value in settings(row).items() if name.startswith("evaluate.")}


def difference(ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> dict[str, Any]:
    """``theirs`` where it differs from ``ours``; another variant is one difference, whatever its fields are."""
    other = {name for name in {*ours, *theirs} if ours.get(name) != theirs.get(name)}
    return {name: theirs.get(name) for name in sorted(other) if not any(name.startswith(f"{o}.") for o in other)}


def base_of(rows: Sequence[RunRecord]) -> RunRecord:
    """The run that most others are a step away from; of equals one that was no job of a sweep, or else the first.

    Never one with an oracle or with parts switched off, as long as there is another.
    """
    rows = [row for row in rows if is_plain(row)] or rows
    asked = [settings(row) for row in rows]
    near = [sum(len(difference(mine, other)) == 1 for other in asked) for mine in asked]
    return rows[max(range(len(rows)), key=lambda i: (near[i], bool(rows[i].config), not rows[i].sweep, -i))]


def is_oracle(row: RunRecord) -> bool:
    """Whether any stage of a run was shown the truth."""
    return "oracle" in row.label.values() or "extract.coordinates." in str(row.config.get("extract"))


def is_plain(row: RunRecord) -> bool:
    """Whether a run is the method as it is: no oracle, nothing switched off by a variation."""
    return not is_oracle(row) and row.config.get("variation", "none") == "none"


def families(rows: Sequence[RunRecord]) -> list[Family]:
    """All families of rows of one dataset, the widest base first. Rows of switched-off or oracle parts are left out."""
    left = [row for row in rows if row.config and is_plain(row)]
    left = list({str(settings(row)): row for row in reversed(left)}.values())[::-1]
    found: list[Family] = []
    while len(left) > 1 and len(found) < MOST_FAMILIES:
        base = base_of(left)
        of_base = _around(base, left)
        if not of_base:
            break
        found += of_base
        taken = {row.id for family in of_base for row in family.rows}
        left = [row for row in left if row.id not in taken]
    return found[:MOST_FAMILIES]


def _around(base: RunRecord, rows: Sequence[RunRecord]) -> list[Family]:
    by_axis: dict[str, list[tuple[RunRecord, Any]]] = {}
    for row in rows:
        changed = difference(settings(base), settings(row))
        if len(changed) == 1:
            ((axis, value),) = changed.items()
            by_axis.setdefault(axis, []).append((row, value))
    families_ = []
    for axis, members in sorted(by_axis.items(), key=lambda item: -len(item[1])):
        members.append((base, settings(base).get(axis)))
        ordered = sorted(members, key=lambda member: _order(member[1]))
        families_.append(Family(axis, base, tuple(r for r, _ in ordered), tuple(v for _, v in ordered)))
    return families_


def _order(value: Any) -> tuple[int, float, str]:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return (0, float(value), "") if is_number else (1, 0.0, str(value))


def _flat(name: str, value: Any) -> dict[str, Any]:
    """A variant by its name, its fields and those of variants within it by dotted names; anything else as it is."""
    if not (isinstance(value, Mapping) and "_target_" in value):
        return {name: _plain(value)}
    found = {name: value["_target_"].rsplit(".", 2)[-2]}
    for field, inner in value.items():
        found |= _flat(f"{name}.{field}", inner) if field != "_target_" else {}
    return found


def _plain(value: Any) -> Any:
    return tuple(_plain(v) for v in value) if isinstance(value, (list, tuple)) else value
