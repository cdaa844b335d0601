"""One run's record on disk: ``<out>/rows/<id>.json``. Reports are made from these files alone."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from pipeline.errors import BadInput
from pipeline.io.files import write_json
from pipeline.items.errors import TemplateError
from pipeline.items.records import scores_from_record, scores_to_record
from pipeline.items.scores import DatasetId, Scores
from pipeline.spec import digest

FORMAT = 1
FOLDER = "rows"
# fields of the configuration that change neither estimates nor scores
NOT_IDENTIFYING = (
    "step",
    "plan",
    "out",
    "overlays",
    "gallery",
    "threads",
    "runtime",
    "store",
    "hydra",
    "sweep",
    "report",
    "weights",
)


@dataclass(frozen=True)
class Case:
    """One picture of the gallery.

    ``file`` is relative to the run's folder; ``relative_mssd`` is MSSD over the object's diameter.
    """

    file: str
    scene_id: int
    im_id: int
    obj_id: int
    relative_mssd: float | None
    text: str


@dataclass(frozen=True, eq=False)
class RunRecord:
    """Results of one run, or why it failed.

    ``config``: the resolved configuration. ``label``: the variant of every stage. ``detections``: what the detections
    are, and ``answers``: digest of poses and scores; both "" in records of earlier versions. ``counts``: by step, how
    many items were computed and reused, and seconds. ``times_s``: by stage, median seconds of a target. ``failures``:
    (stage, reason, count) of targets without a pose. ``templates``: errors of the matched templates by (scene_id,
    im_id, obj_id, gt_id). ``metrics``: average recalls and other summary figures. ``folder``: where csv, poses.json and
    pictures are, relative to ``out``. ``machines``: what computed the entries it used, one line each.
    ``confidences``: confidence of each scored pose, and whether its MSSD is below 20 % of the diameter. A failed run
    has ``error`` and its command-line ``overrides``, and defaults for everything it did not reach.
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
    detections: str = ""
    dataset: DatasetId | None = None
    run: str = ""
    folder: str = ""
    csv: str = ""
    answers: str = ""
    estimates: int = 0
    counts: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    times_s: Mapping[str, float] = field(default_factory=dict)
    bytes_per_object: float = 0.0
    failures: tuple[tuple[str, str, int], ...] = ()
    metrics: Mapping[str, float | None] = field(default_factory=dict)
    scores: Scores | None = None
    templates: Mapping[tuple[int, int, int, int], TemplateError] = field(default_factory=dict)
    cases: tuple[Case, ...] = ()
    machines: tuple[str, ...] = ()
    confidences: tuple[tuple[float, bool], ...] = ()

    def require_scores(self) -> Scores:
        """The scores of a run that was evaluated."""
        assert self.scores is not None, f"run {self.id} has no scores"
        return self.scores


def run_id(config: Mapping[str, Any]) -> str:
    """Identity of a run: digest of its configuration without the fields that cannot change results."""
    return digest({name: value for name, value in config.items() if name not in NOT_IDENTIFYING})[:16]


def unresolved_failures(records: Sequence[RunRecord]) -> list[RunRecord]:
    """Failed runs whose job has not succeeded since.

    Jobs are compared without the location of their weights: a rerun may read the same model from another folder.
    """
    done = {
        digest(_without_locations(record.config)): record.at
        for record in sorted(records, key=lambda r: r.at)
        if record.status == "done"
    }
    failed = [record for record in records if record.status == "failed"]
    return [record for record in failed if done.get(digest(_without_locations(record.config)), "") <= record.at]


def _without_locations(value: Any) -> Any:
    """A configuration without fields that cannot change results and without locations of weights.

    ``weights`` is a location only where a ``revision`` belongs to it; elsewhere it is a setting.
    """
    if not isinstance(value, Mapping):
        return value
    dropped = {*NOT_IDENTIFYING, "revision"} if "revision" in value or "method" in value else set()
    return {name: _without_locations(item) for name, item in value.items() if name not in dropped}


def run_record_path(out: Path, id_: str) -> Path:
    """File of a run's record."""
    return out / FOLDER / f"{id_}.json"


def write_run_record(out: Path, record: RunRecord) -> Path:
    """Write a record atomically; returns its path."""
    path = run_record_path(out, record.id)
    write_json(path, {"format": FORMAT, **_to_json(record)})
    return path


def read_run_record(path: Path) -> RunRecord:
    """Read one record. Raises BadInput for any other file."""
    try:
        content = json.loads(path.read_text())
        if content.pop("format") != FORMAT:
            raise BadInput(path, found="a run record of another version", needed=f"format {FORMAT}: run it again")
        return _from_json(content)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        found = f"{type(error).__name__}: {error}"
        raise BadInput(path, found=found, needed="a run record; remove the file") from None


def finished_run_record(out: Path, id_: str) -> RunRecord | None:
    """The record of a run that succeeded; None if it is missing, unreadable or of a failed run."""
    try:
        record = read_run_record(run_record_path(out, id_))
    except BadInput:
        return None
    return record if record.status == "done" else None


def read_run_records(out: Path) -> list[RunRecord]:
    """All records below ``out``, oldest first. Raises BadInput if one is broken or there are none."""
    paths = sorted((out / FOLDER).glob("*.json"))
    if not paths:
        raise BadInput(out / FOLDER, found="no run records", needed="finished runs: run step=all (or evaluate) first")
    records, faults = [], []
    for path in paths:
        try:
            records.append(read_run_record(path))
        except BadInput as fault:
            faults.append(fault)
    if faults:
        more = f"; {len(faults) - 1} other files of {len(paths)} are also broken" if len(faults) > 1 else ""
        raise BadInput(faults[0].where, found=faults[0].found + more, needed=faults[0].needed)
    return sorted(records, key=lambda record: (record.at, record.id))


def _to_json(record: RunRecord) -> dict[str, Any]:
    content = {f.name: getattr(record, f.name) for f in fields(record) if f.name not in ("scores", "templates")}
    content["dataset"] = record.dataset and asdict(record.dataset)
    content["cases"] = [asdict(case) for case in record.cases]
    content["scores"] = None if record.scores is None else scores_to_record(record.scores)
    content["templates"] = [[*instance, *asdict(error).values()] for instance, error in record.templates.items()]
    return content


_TEXT_FIELDS = (
    "id",
    "status",
    "at",
    "method",
    "error",
    "sweep",
    "notice",
    "detections",
    "answers",
    "run",
    "folder",
    "csv",
)
_OBJECT_FIELDS = ("config", "label", "counts", "times_s", "metrics")


def _check_types(content: Mapping[str, Any]) -> None:
    """Raise TypeError for a field whose type the report cannot use."""
    for name in _TEXT_FIELDS:
        if not isinstance(content.get(name, ""), str):
            raise TypeError(f"{name} is not a string")
    for name in _OBJECT_FIELDS:
        if not isinstance(content.get(name, {}), dict):
            raise TypeError(f"{name} is not a JSON object")
    for name in ("estimates", "bytes_per_object"):
        if not isinstance(content.get(name, 0), (int, float)):
            raise TypeError(f"{name} is not a number")
    if not all(isinstance(machine, str) for machine in content.get("machines", ())):
        raise TypeError("machines are not strings")
    counts = content["counts"].values()
    if not all(isinstance(count, dict) and {"computed", "reused"} <= set(count) for count in counts):
        raise TypeError("counts lack computed and reused")
    if not all(isinstance(seconds, (int, float)) for seconds in content["times_s"].values()):
        raise TypeError("times_s has a value that is not a number")


def _check_places(content: Mapping[str, Any]) -> None:
    """Raise ValueError for a path that leads out of the results folder, or a name that is none."""
    paths = [content.get("folder", ""), content.get("csv", ""), *(case.get("file", "") for case in content["cases"])]
    for path in map(str, paths):
        if Path(path).is_absolute() or ".." in Path(path).parts or "\0" in path:
            raise ValueError(f"{path[:80]!r} lies outside the results folder")
    names = [
        content.get("method", ""),
        *(str((content.get("dataset") or {}).get(key, "")) for key in ("name", "split")),
    ]
    for name in names:
        if "/" in name or "\\" in name or "\0" in name or name in (".", ".."):
            raise ValueError(f"{name[:80]!r} is no name")


def _from_json(content: dict[str, Any]) -> RunRecord:
    _check_types(content)
    _check_places(content)
    dataset = content.pop("dataset")
    cases = tuple(Case(**case) for case in content.pop("cases"))
    scores = content.pop("scores")
    templates = {(s, i, o, g): TemplateError(*angles) for s, i, o, g, *angles in content.pop("templates")}
    content["overrides"] = tuple(content["overrides"])
    content["machines"] = tuple(content.get("machines", ()))
    content["confidences"] = tuple((float(value), bool(right)) for value, right in content.get("confidences", ()))
    failures = tuple((stage, reason, count) for stage, reason, count in content.pop("failures"))
    return RunRecord(
        **content,
        dataset=dataset and DatasetId(**{**dataset, "objects": tuple(dataset["objects"])}),
        cases=cases,
        scores=None if scores is None else scores_from_record(scores),
        templates=templates,
        failures=failures,
    )
