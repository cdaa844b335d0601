"""results csv -> faults and warnings: what BOP's server and tools would reject or misread."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.bop.dataset import Dataset
from pipeline.bop.results import COLUMNS, ResultRow, parse_results_name, scan_results

ORTHONORMAL = 1e-3
"""Largest entry of |R R^T - I| without a warning (three decimals exceed it); above ROTATION_TOLERANCE it is a fault."""
_MAX_DISTANCE_MM = 1e6
_MIN_DISTANCE_MM = 20.0  # a smaller median distance is in metres: no camera sees an object 2 cm away


@dataclass(frozen=True)
class LintReport:
    """``faults`` make a submission invalid or wrong; ``warnings`` may be intended."""

    rows: int
    faults: tuple[str, ...]
    warnings: tuple[str, ...]


def lint(path: Path, data: Dataset | None) -> LintReport:
    """Check a csv's name, columns, numbers, rotations, units and times; with a dataset also its ids and coverage.

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
    faults += _check_units(path, rows)
    warnings += _check_poses(rows) + _check_times(rows)
    if data is not None:
        more_faults, more_warnings = _check_targets(path, rows, data)
        faults, warnings = faults + more_faults, warnings + more_warnings
    else:
        warnings.append("ids and coverage of the targets were not checked: that needs --dataset")
    return LintReport(len(rows), tuple(faults), tuple(warnings))


def _check_units(path: Path, rows: Sequence[ResultRow]) -> list[str]:
    """Faults: translations that are not in mm."""
    largest = max(float(np.abs(row.T_cam_obj[:3, 3]).max()) for row in rows)
    if largest > _MAX_DISTANCE_MM:
        return [f"{path}, field t: found {largest:.3g}, needs millimetres: no camera sees an object that far away"]
    distance = float(np.median([np.linalg.norm(row.T_cam_obj[:3, 3]) for row in rows]))
    if distance < _MIN_DISTANCE_MM:
        return [f"{path}, field t: found a median distance of {distance:.3g}, needs millimetres (it looks like metres)"]
    return []


def _check_poses(rows: Sequence[ResultRow]) -> list[str]:
    """Warnings: imprecise rotations, objects too near or behind the camera."""
    error = np.array([np.abs(r.T_cam_obj[:3, :3] @ r.T_cam_obj[:3, :3].T - np.eye(3)).max() for r in rows])
    behind = sum(row.T_cam_obj[2, 3] <= 0 for row in rows)
    near = sum(np.linalg.norm(row.T_cam_obj[:3, 3]) < _MIN_DISTANCE_MM for row in rows)
    warnings = []
    if (error > ORTHONORMAL).any():
        count = (error > ORTHONORMAL).sum()
        warnings.append(f"R of {count} rows is orthonormal only to {error.max():.2g} (too few digits?)")
    if near:
        warnings.append(f"t of {near} rows is shorter than {_MIN_DISTANCE_MM:g} mm (in metres?)")
    if behind:
        warnings.append(f"{behind} poses are behind the camera")
    return warnings


def _check_times(rows: Sequence[ResultRow]) -> list[str]:
    unknown = sum(row.time_s == -1 for row in rows)
    return [f"the time of {unknown} rows is unknown (-1)"] if unknown else []


def _check_targets(path: Path, rows: Sequence[ResultRow], data: Dataset) -> tuple[list[str], list[str]]:
    """Faults and warnings: ids and numbers of estimates compared with the dataset's targets."""
    targets = {(t.scene_id, t.im_id, t.obj_id): t.inst_count for t in data.targets}
    images = {(t.scene_id, t.im_id) for t in data.targets}
    given = Counter((row.scene_id, row.im_id, row.obj_id) for row in rows)
    faults = [
        f"{path}: found scene {s}, image {i}, needs a target image of {data.root}"
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
    if ignored := sum(n for key, n in given.items() if key not in targets and key[:2] in images):
        warnings.append(f"{ignored} estimates are of objects that are not targets of their image: they do not count")
    if surplus := sum(max(0, given[target] - count) for target, count in targets.items()):
        warnings.append(f"{surplus} estimates exceed the number of instances asked for: only the best-scored count")
    return faults, warnings
