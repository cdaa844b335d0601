"""results csv -> what BOP's servers or tools would stumble over."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.bop.dataset import Dataset
from pipeline.bop.results import COLUMNS, ResultRow, parse_results_name, scan_results

ORTHONORMAL = 1e-3
"""A rotation further off (written with three decimals, say) is a note; off ROTATION_TOLERANCE it is a fault."""
_FARTHEST_MM = 1e6
_METRES_MM = 20.0  # a median distance below it is one in metres: no camera sees an object 2 cm away


@dataclass(frozen=True)
class LintReport:
    """What a check found: ``faults`` make a submission invalid or wrong, ``warnings`` may be meant so."""

    rows: int
    faults: tuple[str, ...]
    warnings: tuple[str, ...]


def lint(path: Path, data: Dataset | None) -> LintReport:
    """All faults of a csv: name, columns, numbers, rotations, units, times; with a dataset also ids and coverage.

    Raises BadInput for a file that cannot be read.
    """
    rows, broken = scan_results(path)
    faults = [str(fault) for fault in broken]
    warnings: list[str] = []
    if parse_results_name(path) is None:
        needed = "<method>_<dataset>-<split>.csv, no underscore in the method's name"
        faults.insert(0, f"{path.name}: found another name, needs {needed}")
    if not rows:
        faults.append(f"{path}: found no estimate, needs rows of {','.join(COLUMNS)}")
        return LintReport(0, tuple(faults), ())
    faults += _units(path, rows)
    warnings += _precision(rows) + _times(rows)
    if data is not None:
        more_faults, more_warnings = _against(path, rows, data)
        faults, warnings = faults + more_faults, warnings + more_warnings
    else:
        warnings.append("ids and coverage of the targets were not checked: that needs --dataset")
    return LintReport(len(rows), tuple(faults), tuple(warnings))


def _units(path: Path, rows: Sequence[ResultRow]) -> list[str]:
    largest = max(float(np.abs(row.T_cam_obj[:3, 3]).max()) for row in rows)
    if largest > _FARTHEST_MM:
        return [f"{path}, field t: found {largest:.3g}, needs millimetres: no camera sees an object that far"]
    distance = float(np.median([np.linalg.norm(row.T_cam_obj[:3, 3]) for row in rows]))
    if distance < _METRES_MM:
        return [f"{path}, field t: found a median distance of {distance:.3g}, needs millimetres (it looks like metres)"]
    return []


def _precision(rows: Sequence[ResultRow]) -> list[str]:
    off = np.array([np.abs(r.T_cam_obj[:3, :3] @ r.T_cam_obj[:3, :3].T - np.eye(3)).max() for r in rows])
    behind = sum(row.T_cam_obj[2, 3] <= 0 for row in rows)
    near = sum(np.linalg.norm(row.T_cam_obj[:3, 3]) < _METRES_MM for row in rows)
    notes = []
    if (off > ORTHONORMAL).any():
        notes.append(f"R of {(off > ORTHONORMAL).sum()} rows is orthonormal to {off.max():.2g} only (few digits?)")
    if near:
        notes.append(f"t of {near} rows is shorter than {_METRES_MM:g} mm (in metres?)")
    if behind:
        notes.append(f"{behind} poses lie behind the camera")
    return notes


def _times(rows: Sequence[ResultRow]) -> list[str]:
    unknown = sum(row.time_s == -1 for row in rows)
    return [f"the time of {unknown} rows is unknown (-1)"] if unknown else []


def _against(path: Path, rows: Sequence[ResultRow], data: Dataset) -> tuple[list[str], list[str]]:
    targets = {(t.scene_id, t.im_id, t.obj_id): t.inst_count for t in data.targets}
    images = {(t.scene_id, t.im_id) for t in data.targets}
    given = Counter((row.scene_id, row.im_id, row.obj_id) for row in rows)
    faults = [
        f"{path}: found scene {s}, image {i}, needs an image of the targets of {data.root}"
        for s, i in sorted({(s, i) for s, i, _ in given} - images)
    ]
    objects = sorted({o for _, _, o in given if not data.model_path(o).exists()})
    faults += [f"{path}: found object {o}, needs an object with a model in {data.root / data.models}" for o in objects]
    warnings = []
    missing = [target for target in targets if not given[target]]
    if missing:
        s, i, o = missing[0]
        warnings.append(
            f"{len(missing)} of {len(targets)} targets have no estimate (first: scene {s}, image {i}, object {o})"
        )
    if aside := sum(n for key, n in given.items() if key not in targets and key[:2] in images):
        warnings.append(f"{aside} estimates are of objects that are no target of their image: they do not count")
    if more := sum(max(0, given[target] - count) for target, count in targets.items()):
        warnings.append(f"{more} estimates are more than their targets ask for: the best-scored count")
    return faults, warnings
