"""poses <-> the results csv of the BOP challenge: ``scene_id,im_id,obj_id,score,R,t,time``."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.bop.scene import describe_rotation_fault
from pipeline.errors import BadInput
from pipeline.functional.rigid import rigid
from pipeline.io.files import read_file, write_atomic
from pipeline.items.poses import PoseEstimate

COLUMNS = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")
_HEADER = ",".join(COLUMNS)
_NAME_LENGTH = 80
_TIME_TOLERANCE_S = 1e-3  # largest difference between the times of one image that bop_toolkit accepts


@dataclass(frozen=True, eq=False)
class ResultRow:
    """One estimated pose, mm. ``time_s``: seconds spent on the whole image, equal in all its rows; -1: unknown."""

    scene_id: int
    im_id: int
    obj_id: int
    score: float
    T_cam_obj: Float[np.ndarray, "4 4"]
    time_s: float


def results_name(method: str, dataset: str, split: str = "test") -> str:
    """BOP's file name, ``<method>_<dataset>-<split>.csv``, without the split's sensor ("test_primesense" -> "test").

    Raises BadInput for names with an underscore, at which BOP's tools split the file name, and with characters that
    are special to a file system, shell or spreadsheet.
    """
    for field, name, others in (("method", method, ""), ("dataset.name", dataset, ""), ("dataset.split", split, "_")):
        if not re.fullmatch(rf"[A-Za-z0-9][A-Za-z0-9.{others}-]{{0,{_NAME_LENGTH - 1}}}", name):
            needed = f"at most {_NAME_LENGTH} letters, digits, dots and hyphens, the first a letter or digit"
            raise BadInput(field, found=repr(name), needed=needed + ("" if others else ", no underscore"))
    return f"{method}_{dataset}-{split.split('_')[0]}.csv"


def parse_results_name(path: Path) -> tuple[str, str, str] | None:
    """(method, dataset, split) of ``<method>_<dataset>-<split>.csv``, None for another name.

    As in BOP's tools, anything after a further underscore is ignored.
    """
    parts = re.fullmatch(r"([^_]+)_([^_-]+)-([^_]+)(?:_.*)?", path.stem)
    return (parts[1], parts[2], parts[3]) if parts and path.suffix == ".csv" else None


def make_rows(
    estimates: Sequence[PoseEstimate], times_by_image: Mapping[tuple[int, int], float] | None = None
) -> list[ResultRow]:
    """One row per estimate, sorted by scene, image, object and descending score.

    ``times_by_image``: seconds by (scene_id, im_id); images without an entry get -1 (unknown).
    """
    times = times_by_image or {}
    rows = [
        ResultRow(e.scene_id, e.im_id, e.obj_id, e.score, e.T_cam_obj, times.get((e.scene_id, e.im_id), -1.0))
        for e in estimates
    ]
    return sorted(rows, key=lambda row: (row.scene_id, row.im_id, row.obj_id, -row.score))


def write_results(path: Path, rows: Iterable[ResultRow]) -> None:
    """Write the csv atomically. Floats are written with ``repr``, so that reading them returns the same values."""
    write_atomic(path, "\n".join([_HEADER, *map(_format_row, rows), ""]).encode("ascii"))


def read_results(path: Path) -> list[ResultRow]:
    """Rows in file order; the header line is optional. Raises BadInput, with line and field, at the first fault."""
    rows, faults = scan_results(path)
    if faults:
        raise faults[0]
    return rows


def scan_results(path: Path) -> tuple[list[ResultRow], list[BadInput]]:
    """All valid rows in file order, and the faults of the others. Raises BadInput for an unreadable file."""
    try:
        lines = read_file(path, "a BOP results csv").decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise BadInput(path, found="bytes that are not text", needed="a BOP results csv") from None
    rows: list[ResultRow] = []
    faults: list[BadInput] = []
    times: dict[tuple[int, int], float] = {}
    for number, line in enumerate(lines, start=1):
        if not line.strip() or (number == 1 and [c.strip() for c in line.split(",")] == list(COLUMNS)):
            continue
        try:
            row = _parse_row(line, f"{path}, line {number}")
            _check_time(row, times, f"{path}, line {number}")
        except BadInput as fault:
            faults.append(fault)
        else:
            rows.append(row)
    return rows, faults


def _check_time(row: ResultRow, times: dict[tuple[int, int], float], where: str) -> None:
    """Raise BadInput if the row's time differs from that of earlier rows of its image, kept in ``times``."""
    known = times.setdefault((row.scene_id, row.im_id), row.time_s)
    if abs(known - row.time_s) > _TIME_TOLERANCE_S:
        found = f"{row.time_s:g} after {known:g} for scene {row.scene_id}, image {row.im_id}"
        raise BadInput(f"{where}, field time", found=found, needed="one time for all rows of an image")


def _format_row(row: ResultRow) -> str:
    R, t = row.T_cam_obj[:3, :3].ravel(), row.T_cam_obj[:3, 3]
    texts = [" ".join(repr(float(v)) for v in values) for values in (R, t)]
    ids = [row.scene_id, row.im_id, row.obj_id]
    return ",".join([*map(str, ids), repr(float(row.score)), *texts, repr(float(row.time_s))])


def _parse_row(line: str, where: str) -> ResultRow:
    cells = line.split(",")
    if len(cells) != len(COLUMNS):
        raise BadInput(where, found=f"{len(cells)} columns", needed=f"{len(COLUMNS)}: {_HEADER}")
    ids = [_parse_id(cell, f"{where}, field {name}") for name, cell in zip(COLUMNS, cells[:3], strict=False)]
    score, R, t, time_s = (
        _parse_numbers(cell, count, f"{where}, field {name}")
        for name, cell, count in zip(COLUMNS[3:], cells[3:], (1, 9, 3, 1), strict=True)
    )
    if fault := describe_rotation_fault(R.reshape(3, 3)):
        raise BadInput(f"{where}, field R", found=fault, needed="a rotation matrix, row by row")
    if time_s[0] < 0 and time_s[0] != -1:
        raise BadInput(f"{where}, field time", found=f"{time_s[0]:g}", needed="seconds >= 0, or -1 for unknown")
    return ResultRow(ids[0], ids[1], ids[2], float(score[0]), rigid(R.reshape(3, 3), t), float(time_s[0]))


def _parse_id(cell: str, where: str) -> int:
    try:
        value = int(cell)
    except ValueError:
        value = -1
    if value < 0:
        raise BadInput(where, found=repr(cell[:60]), needed="an integer >= 0")
    return value


def _parse_numbers(cell: str, count: int, where: str) -> Float[np.ndarray, " n"]:
    needed = f"{count} finite numbers, separated by spaces" if count > 1 else "a finite number"
    try:
        values = [float(part) for part in cell.split()]
    except ValueError:
        raise BadInput(where, found=repr(cell[:60]), needed=needed) from None
    if len(values) != count or not all(map(math.isfinite, values)):
        raise BadInput(
            where, found=repr(cell[:60]) if len(values) == count else f"{len(values)} numbers", needed=needed
        )
    return np.array(values)
