"""``dzop score`` and ``dzop lint``: any method's results csv, scored and checked as BOP does."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from pipeline.bop.dataset import Dataset, open_dataset
from pipeline.bop.lint import lint
from pipeline.bop.results import ResultRow, parse_results_name, read_results
from pipeline.errors import BadInput, DzopError
from pipeline.io.digests import file_digest
from pipeline.io.files import write_json
from pipeline.metrics.bootstrap import Interval, image_index, paired_interval
from pipeline.metrics.recall import instance_ar
from pipeline.progress import Progress
from pipeline.report.run_records import RunRecord, write_run_record
from pipeline.report.scores import scores_table, summary_of
from pipeline.scoring import VSD_DELTA_MM, Scorer, ScoringResult, dataset_id
from pipeline.spec import digest

TARGETS = "test_targets_bop19.json"
FAULTS_SHOWN = 20


@dataclass(frozen=True, eq=False)
class Scoreable:
    """A csv and what it is held against."""

    path: Path
    method: str
    rows: list[ResultRow]
    scorer: Scorer


def score_command(arguments: Sequence[str]) -> None:
    """``dzop score RESULTS.csv --dataset ROOT``. Raises BadInput in one line for whatever cannot be scored."""
    asked = _score_parser().parse_args(arguments)
    ours = _opened(asked, Path(asked.results))
    _said(ours)
    scored = _scored(ours)
    print(scores_table(scored))
    record = {"csv": ours.path.name, "dataset": ours.scorer.dataset.name, **summary_of(scored)}
    if asked.against:
        theirs = _opened(asked, Path(asked.against))
        difference = _difference(scored, _scored(theirs))
        print(f"\nmean recall minus that of {theirs.path.name}: {_signed(difference)} (paired over images)")
        record["against"] = {"csv": theirs.path.name, **vars(difference)}
    if asked.json:
        write_json(Path(asked.json), record)
        print(f"json      {asked.json}")
    if asked.out:
        print(f"row       {write_run_record(Path(asked.out), _row(ours, scored))}")


def lint_command(arguments: Sequence[str]) -> None:
    """``dzop lint RESULTS.csv [--dataset ROOT]``. Raises DzopError when there are faults, all of them printed."""
    parser = argparse.ArgumentParser(prog="dzop lint", description="Check a results csv before it is submitted.")
    parser.add_argument("results", help="the csv: <method>_<dataset>-<split>.csv")
    _dataset_options(parser, required=False)
    asked = parser.parse_args(arguments)
    path = Path(asked.results)
    data = None if asked.dataset is None else _open_dataset(asked, path, models=asked.models)
    report = lint(path, data)
    for fault in report.faults[:FAULTS_SHOWN]:
        print(f"fault: {fault}")
    if len(report.faults) > FAULTS_SHOWN:
        print(f"and {len(report.faults) - FAULTS_SHOWN} faults more")
    for warning in report.warnings:
        print(f"note:  {warning}")
    counts = [
        _counted(report.rows, "row"),
        _counted(len(report.faults), "fault"),
        _counted(len(report.warnings), "note"),
    ]
    print(f"{path}: {', '.join(counts)}")
    if report.faults:
        raise DzopError(f"{path}: found {_counted(len(report.faults), 'fault')}, told above")


def _score_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="dzop score", description="Score any method's results csv as BOP does.")
    parser.add_argument("results", help="the csv; its name, <method>_<dataset>-<split>.csv, says what it is")
    _dataset_options(parser, required=True)
    parser.add_argument("--no-vsd", action="store_true", help="leave VSD out; it is the one that takes long")
    parser.add_argument("--subset", action="store_true", help="leave out rows of images and objects not there")
    parser.add_argument("--against", metavar="CSV", help="another csv: the difference, paired over images")
    parser.add_argument("--json", metavar="FILE", help="write all figures there")
    parser.add_argument("--out", metavar="FOLDER", help="leave a row there for the report (step=report out=FOLDER)")
    return parser


def _dataset_options(parser: argparse.ArgumentParser, *, required: bool) -> None:
    parser.add_argument("--dataset", required=required, metavar="ROOT", help="the dataset's folder, in BOP format")
    parser.add_argument("--split", help="folder of the scenes in it (default: from the csv's name)")
    parser.add_argument("--targets", default=TARGETS, help=f"file of the targets in it (default: {TARGETS})")
    parser.add_argument("--models", help="folder of the meshes in it (default: models_eval, else models)")


def _opened(asked: argparse.Namespace, path: Path) -> Scoreable:
    rows = read_results(path)
    if not rows:
        raise BadInput(path, found="no estimate", needed="rows of scene_id,im_id,obj_id,score,R,t,time")
    data = _open_dataset(asked, path, models=asked.models)
    kept = _known(path, rows, data, subset=asked.subset)
    delta = VSD_DELTA_MM.get(data.name, 15.0)
    scorer = Scorer(data, data.targets, data.models, vsd_delta_mm=delta, with_vsd=not asked.no_vsd)
    parts = parse_results_name(path)
    return Scoreable(path, parts[0] if parts else path.stem, kept, scorer)


def _open_dataset(asked: argparse.Namespace, path: Path, *, models: str | None) -> Dataset:
    root, parts = Path(asked.dataset).expanduser(), parse_results_name(path)
    split = asked.split or _split_folder(root, parts[2] if parts else "test")
    if models is None:
        models = "models_eval" if (root / "models_eval").is_dir() else "models"
    if not (root / asked.targets).exists() and asked.targets != TARGETS:
        raise BadInput(root / asked.targets, found="no such file", needed="the targets file that --targets names")
    name = parts[1] if parts else root.resolve().name
    return open_dataset(root, name=name, split=split, models=models, targets=asked.targets, photographs=False)


def _split_folder(root: Path, split: str) -> str:
    """The split's folder; BOP's csv names leave its sensor out ("test" for test_primesense)."""
    with_sensor = sorted(p.name for p in root.glob(f"{split}_*") if p.is_dir() and any(p.glob("[0-9]" * 6)))
    return split if (root / split).is_dir() or len(with_sensor) != 1 else with_sensor[0]


def _known(path: Path, rows: list[ResultRow], data: Dataset, *, subset: bool) -> list[ResultRow]:
    """The rows of images and objects that the dataset has. Raises BadInput for others, unless they may be left out."""
    scenes = {p.name for p in (data.root / data.split).iterdir() if p.is_dir()}
    images = {s: set(data.scene(s).annotations) for s in {r.scene_id for r in rows} if f"{s:06d}" in scenes}
    objects = {obj_id for obj_id in {r.obj_id for r in rows} if data.model_path(obj_id).exists()}
    kept = [r for r in rows if r.im_id in images.get(r.scene_id, ()) and r.obj_id in objects]
    if len(kept) == len(rows) or subset:
        return kept
    strange = next(r for r in rows if not (r.im_id in images.get(r.scene_id, ()) and r.obj_id in objects))
    what = f"scene {strange.scene_id}, image {strange.im_id}, object {strange.obj_id}"
    raise BadInput(
        path,
        found=f"{len(rows) - len(kept)} of {len(rows)} rows of what {data.root} does not have, the first: {what}",
        needed="ids of annotated images and of models there (--subset leaves the others out)",
    )


def _said(given: Scoreable) -> None:
    """What is scored, and what is left out."""
    data, targets = given.scorer.dataset, {(t.scene_id, t.im_id, t.obj_id) for t in given.scorer.targets}
    covered = {(r.scene_id, r.im_id, r.obj_id) for r in given.rows} & targets
    aside = sum((r.scene_id, r.im_id, r.obj_id) not in targets for r in given.rows)
    print(f"{given.path.name}: {len(given.rows)} estimates on {data.root} ({data.split}, errors on {data.models})")
    print(f"{len(targets)} targets in {len(given.scorer.images)} images, {len(covered)} of them with an estimate")
    if aside:
        print(f"{aside} estimates of what is not a target are left out")


def _scored(given: Scoreable) -> ScoringResult:
    with Progress().bar(len(given.scorer.images), given.path.name, "image") as advance:
        return given.scorer.score(given.rows, progress=advance)


def _difference(ours: ScoringResult, theirs: ScoringResult) -> Interval:
    mine, other = ours.scores, theirs.scores
    image = image_index(mine.scene_id, mine.im_id)
    return paired_interval(instance_ar(mine), instance_ar(other), image)


def _signed(value: Interval) -> str:
    return f"{value.mean:+.4f} [{value.low:+.4f}, {value.high:+.4f}]"


def _row(given: Scoreable, scored: ScoringResult) -> RunRecord:
    """A row for the report: the figures of a csv, without what only a run of ours knows."""
    identity = {"csv": file_digest(given.path), "dataset": dataset_id(given.scorer).key}
    return RunRecord(
        id=digest(identity)[:16],
        status="done",
        at=datetime.now(UTC).isoformat(timespec="seconds"),
        method=given.method,
        config={},
        label={},
        dataset=dataset_id(given.scorer),
        run=identity["csv"],
        csv=given.path.name,
        estimates=len(given.rows),
        metrics=summary_of(scored)["metrics"],
        scores=scored.scores,
    )


def _counted(number: int, thing: str) -> str:
    return f"{number} {thing}{'' if number == 1 else 's'}"
