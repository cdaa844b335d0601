"""What a run leaves behind for reports: one JSON file, ``<out>/rows/<id>.json``, whether it ended well or failed."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from pipeline.errors import BadInput
from pipeline.io.files import write_json
from pipeline.items.scores import DatasetId, Scores, TemplateError, scores_of, scores_record
from pipeline.spec import digest

FORMAT = 1
FOLDER = "rows"
# none of these changes an answer or a score
UNTOLD = ("step", "plan", "out", "overlays", "gallery", "threads", "runtime", "store", "hydra", "sweep", "report",
          "weights")  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One picture of the gallery. ``file`` is relative to the row's folder; ``relative_mssd`` MSSD over diameter."""

    file: str
    scene_id: int
    im_id: int
    obj_id: int
    relative_mssd: float | None
    text: str


@dataclass(frozen=True, eq=False)
class Row:
    """One run.

    ``config``: the whole resolved configuration; ``label``: the variant of every stage; ``counts``: rows computed and
    reused and seconds by step; ``times_s``: median seconds of a target by stage; ``failures``: (stage, reason, count)
    of answers without a pose; ``templates``: template errors of the instances that had an answer, by
    (scene_id, im_id, obj_id, gt_id); ``metrics``: the figures a person looks for first; ``folder``: of csv, records
    and pictures, relative to ``out``. A failed run has ``error``, the ``overrides`` of
    its job, and nothing of what it did not reach.
    """

    id: str
    status: Literal["done", "failed"]
    at: str
    method: str
    config: Mapping[str, Any]
    label: Mapping[str, str]
    error: str = ""
    overrides: tuple[str, ...] = ()
    sweep: str = ""
    notice: str = ""
    dataset: DatasetId | None = None
    run: str = ""
    folder: str = ""
    csv: str = ""
    estimates: int = 0
    counts: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    times_s: Mapping[str, float] = field(default_factory=dict)
    bytes_per_object: float = 0.0
    failures: tuple[tuple[str, str, int], ...] = ()
    metrics: Mapping[str, float | None] = field(default_factory=dict)
    scores: Scores | None = None
    templates: Mapping[tuple[int, int, int, int], TemplateError] = field(default_factory=dict)
    cases: tuple[Case, ...] = ()


def row_id(config: Mapping[str, Any]) -> str:
    """Identity of a run: its configuration without what changes no answer."""
    return digest({name: value for name, value in config.items() if name not in UNTOLD})[:16]


def standing_failures(rows: Sequence[Row]) -> list[Row]:
    """Failed rows, without those whose job has ended well since: the same but for where its weights lie."""
    done = {digest(_placeless(row.config)): row.at for row in sorted(rows, key=lambda r: r.at) if row.status == "done"}
    failed = [row for row in rows if row.status == "failed"]
    return [row for row in failed if done.get(digest(_placeless(row.config)), "") <= row.at]


def _placeless(value: Any) -> Any:
    """A configuration without what changes no answer, and without places of weights, which have a revision beside."""
    if not isinstance(value, Mapping):
        return value
    left_out = {*UNTOLD, "revision"} if "revision" in value or "method" in value else set()
    return {name: _placeless(item) for name, item in value.items() if name not in left_out}


def row_path(out: Path, id_: str) -> Path:
    """The row's file."""
    return out / FOLDER / f"{id_}.json"


def write_row(out: Path, row: Row) -> Path:
    """Write a row; a reader sees the whole file or none."""
    path = row_path(out, row.id)
    write_json(path, {"format": FORMAT, **_record(row)})
    return path


def read_row(path: Path) -> Row:
    """A row. Raises BadInput for a file that is none."""
    try:
        record = json.loads(path.read_text())
        if record.pop("format") != FORMAT:
            raise BadInput(path, found="a row of another version", needed=f"format {FORMAT}: run it again")
        return _row(record)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        found = f"{type(error).__name__}: {error}"
        raise BadInput(path, found=found, needed="a row that a run has written; remove the file") from None


def done_row(out: Path, id_: str) -> Row | None:
    """The row of a run that ended well; None where there is none, or none that can be read."""
    try:
        row = read_row(row_path(out, id_))
    except BadInput:
        return None
    return row if row.status == "done" else None


def read_rows(out: Path) -> list[Row]:
    """All rows below ``out``, oldest first. Raises BadInput for a broken one and where there is none."""
    paths = sorted((out / FOLDER).glob("*.json"))
    if not paths:
        raise BadInput(out / FOLDER, found="no row", needed="the rows of runs: run step=all (or evaluate) first")
    rows, faults = [], []
    for path in paths:
        try:
            rows.append(read_row(path))
        except BadInput as fault:
            faults.append(fault)
    if faults:
        more = f"; {len(faults) - 1} other files of {len(paths)} likewise" if len(faults) > 1 else ""
        raise BadInput(faults[0].where, found=faults[0].found + more, needed=faults[0].needed)
    return sorted(rows, key=lambda row: (row.at, row.id))


def _record(row: Row) -> dict[str, Any]:
    plain = {f.name: getattr(row, f.name) for f in fields(row) if f.name not in ("scores", "templates")}
    plain["dataset"] = row.dataset and asdict(row.dataset)
    plain["cases"] = [asdict(case) for case in row.cases]
    plain["scores"] = None if row.scores is None else scores_record(row.scores)
    plain["templates"] = [[*instance, *asdict(error).values()] for instance, error in row.templates.items()]
    return plain


_TEXTS = ("id", "status", "at", "method", "error", "sweep", "notice", "run", "folder", "csv")
_MAPS = ("config", "label", "counts", "times_s", "metrics")


def _check_types(record: Mapping[str, Any]) -> None:
    """Raise TypeError for a field that is there with another type than a report works with."""
    for name in _TEXTS:
        if not isinstance(record.get(name, ""), str):
            raise TypeError(f"{name} is no text")
    for name in _MAPS:
        if not isinstance(record.get(name, {}), dict):
            raise TypeError(f"{name} is no JSON object")
    for name in ("estimates", "bytes_per_object"):
        if not isinstance(record.get(name, 0), (int, float)):
            raise TypeError(f"{name} is no number")
    if not all(isinstance(count, dict) and {"computed", "reused"} <= set(count) for count in record["counts"].values()):
        raise TypeError("counts lack computed and reused")
    if not all(isinstance(seconds, (int, float)) for seconds in record["times_s"].values()):
        raise TypeError("times_s holds what is no number")


def _row(record: dict[str, Any]) -> Row:
    _check_types(record)
    dataset = record.pop("dataset")
    cases = tuple(Case(**case) for case in record.pop("cases"))
    scores = record.pop("scores")
    templates = {(s, i, o, g): TemplateError(*angles) for s, i, o, g, *angles in record.pop("templates")}
    record["overrides"] = tuple(record["overrides"])
    failures = tuple((stage, reason, count) for stage, reason, count in record.pop("failures"))
    return Row(
        **record,
        dataset=dataset and DatasetId(**{**dataset, "objects": tuple(dataset["objects"])}),
        cases=cases,
        scores=None if scores is None else scores_of(scores),
        templates=templates,
        failures=failures,
    )
