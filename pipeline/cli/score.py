"""``dzop score`` and ``dzop lint``: score or check any method's results csv with BOP's rules."""

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
MAX_FAULTS_PRINTED = 20


@dataclass(frozen=True, eq=False)
class Submission:
    """The estimates of a results csv and the scorer for their dataset."""

    path: Path
    method: str
    rows: list[ResultRow]
    scorer: Scorer


def score_command(arguments: Sequence[str]) -> None:
    """``dzop score RESULTS.csv --dataset ROOT``. Raises BadInput for a csv or dataset that cannot be scored."""
    options = _score_parser().parse_args(arguments)
    submission = _open_submission(options, Path(options.results))
    _print_coverage(submission)
    result = _score(submission)
    print(scores_table(result))
    record = {"csv": submission.path.name, "dataset": submission.scorer.dataset.name, **summary_of(result)}
    if options.against:
        other = _open_submission(options, Path(options.against))
        difference = _difference(result, _score(other))
        print(f"\nmean recall minus that of {other.path.name}: {_format_interval(difference)} (paired over images)")
        record["against"] = {"csv": other.path.name, **vars(difference)}
    if options.json:
        write_json(Path(options.json), record)
        print(f"json      {options.json}")
    if options.out:
        print(f"record    {write_run_record(Path(options.out), _run_record(submission, result))}")


def lint_command(arguments: Sequence[str]) -> None:
    """``dzop lint RESULTS.csv [--dataset ROOT]``: print faults and notes. Raises DzopError if there are faults."""
    options = _lint_parser().parse_args(arguments)
    path = Path(options.results)
    data = None if options.dataset is None else _open_dataset(options, path)
    report = lint(path, data)
    for fault in report.faults[:MAX_FAULTS_PRINTED]:
        print(f"fault: {fault}")
    if len(report.faults) > MAX_FAULTS_PRINTED:
        print(f"and {len(report.faults) - MAX_FAULTS_PRINTED} more faults")
    for warning in report.warnings:
        print(f"note:  {warning}")
    rows, notes = _pluralize(report.rows, "row"), _pluralize(len(report.warnings), "note")
    faults = _pluralize(len(report.faults), "fault")
    print(f"{path}: {rows}, {faults}, {notes}")
    if report.faults:
        raise DzopError(f"{path}: found {faults}, listed above")


# --- options ----------------------------------------------------------------------------------------------------------


def _score_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="dzop score", description="Score any method's results csv as BOP does.")
    parser.add_argument("results", help="the results csv, named <method>_<dataset>-<split>.csv")
    _add_dataset_options(parser, required=True)
    parser.add_argument("--no-vsd", action="store_true", help="skip VSD, which takes most of the time")
    parser.add_argument("--subset", action="store_true", help="ignore rows of images and objects not in the dataset")
    parser.add_argument("--against", metavar="CSV", help="compare with another csv, paired over images")
    parser.add_argument("--json", metavar="FILE", help="write all scores to FILE")
    parser.add_argument(
        "--out", metavar="FOLDER", help="add the result to the report of FOLDER (step=report out=FOLDER)"
    )
    return parser


def _lint_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="dzop lint", description="Check a results csv before submitting it to BOP.")
    parser.add_argument("results", help="the results csv, named <method>_<dataset>-<split>.csv")
    _add_dataset_options(parser, required=False)
    return parser


def _add_dataset_options(parser: argparse.ArgumentParser, *, required: bool) -> None:
    parser.add_argument("--dataset", required=required, metavar="ROOT", help="folder of a dataset in BOP format")
    parser.add_argument("--split", help="its folder of scenes (default: taken from the csv's name)")
    parser.add_argument("--targets", default=TARGETS, help=f"its targets file (default: {TARGETS})")
    parser.add_argument("--sensor", help="the sensor to read, in scenes with files of several (scene_gt_cam1.json)")
    parser.add_argument("--models", help="its folder of meshes (default: models_eval if there is one, else models)")


# --- reading ----------------------------------------------------------------------------------------------------------


def _open_submission(options: argparse.Namespace, path: Path) -> Submission:
    rows = read_results(path)
    if not rows:
        raise BadInput(path, found="no estimate", needed="rows of scene_id,im_id,obj_id,score,R,t,time")
    data = _open_dataset(options, path)
    known = _select_known(path, rows, data, subset=options.subset)
    delta = VSD_DELTA_MM.get(data.name, 15.0)
    scorer = Scorer(data, data.targets, data.models, vsd_delta_mm=delta, with_vsd=not options.no_vsd)
    parts = parse_results_name(path)
    return Submission(path, parts[0] if parts else path.stem, known, scorer)


def _open_dataset(options: argparse.Namespace, path: Path) -> Dataset:
    """The dataset at ``--dataset``; its name and split default to those in the csv's name."""
    root, parts = Path(options.dataset).expanduser(), parse_results_name(path)
    split = options.split or _find_split(root, parts[2] if parts else "test")
    models = options.models or ("models_eval" if (root / "models_eval").is_dir() else "models")
    if not (root / options.targets).exists() and options.targets != TARGETS:
        raise BadInput(root / options.targets, found="no such file", needed="the targets file that --targets names")
    name = parts[1] if parts else root.resolve().name
    return open_dataset(
        root,
        name=name,
        split=split,
        models=models,
        targets=options.targets,
        sensor=options.sensor,
        photographs=False,
    )


def _find_split(root: Path, split: str) -> str:
    """The folder of a split. The names of BOP's csv files omit the sensor: "test" stands for test_primesense."""
    with_sensor = sorted(p.name for p in root.glob(f"{split}_*") if p.is_dir() and any(p.glob("[0-9]" * 6)))
    return split if (root / split).is_dir() or len(with_sensor) != 1 else with_sensor[0]


def _select_known(path: Path, rows: list[ResultRow], data: Dataset, *, subset: bool) -> list[ResultRow]:
    """Rows whose image and object are in the dataset. Raises BadInput if there are others, unless ``subset``."""
    scenes = {p.name for p in (data.root / data.split).iterdir() if p.is_dir()}
    images = {s: set(data.scene(s).annotations) for s in {r.scene_id for r in rows} if f"{s:06d}" in scenes}
    objects = {obj_id for obj_id in {r.obj_id for r in rows} if data.model_path(obj_id).exists()}

    def is_known(row: ResultRow) -> bool:
        return row.im_id in images.get(row.scene_id, ()) and row.obj_id in objects

    known = [row for row in rows if is_known(row)]
    if len(known) == len(rows) or subset:
        return known
    first = next(row for row in rows if not is_known(row))
    ids = f"scene {first.scene_id}, image {first.im_id}, object {first.obj_id}"
    raise BadInput(
        path,
        found=f"{len(rows) - len(known)} of {len(rows)} rows with ids that {data.root} does not have, the first: {ids}",
        needed="ids of annotated images and of models in the dataset (--subset ignores the others)",
    )


# --- scoring ----------------------------------------------------------------------------------------------------------


def _print_coverage(submission: Submission) -> None:
    """Print how many targets have an estimate, and how many estimates are ignored."""
    scorer, data = submission.scorer, submission.scorer.dataset
    targets = {(t.scene_id, t.im_id, t.obj_id) for t in scorer.targets}
    estimated = [(r.scene_id, r.im_id, r.obj_id) for r in submission.rows]
    ignored = sum(ids not in targets for ids in estimated)
    print(f"{submission.path.name}: {len(estimated)} estimates on {data.root} ({data.split}, errors on {data.models})")
    covered = len(targets.intersection(estimated))
    print(f"{len(targets)} targets in {len(scorer.images)} images, {covered} of them with an estimate")
    if ignored:
        print(f"{ignored} estimates of instances that are not targets are ignored")


def _score(submission: Submission) -> ScoringResult:
    with Progress().bar(len(submission.scorer.images), submission.path.name, "image") as advance:
        return submission.scorer.score(submission.rows, progress=advance)


def _difference(ours: ScoringResult, theirs: ScoringResult) -> Interval:
    image = image_index(ours.scores.scene_id, ours.scores.im_id)
    return paired_interval(instance_ar(ours.scores), instance_ar(theirs.scores), image)


def _format_interval(value: Interval) -> str:
    return f"{value.mean:+.4f} [{value.low:+.4f}, {value.high:+.4f}]"


def _run_record(submission: Submission, result: ScoringResult) -> RunRecord:
    """A record for the report. It has no configuration, counts or times, which a csv does not contain."""
    dataset = dataset_id(submission.scorer)
    identity = {"csv": file_digest(submission.path), "dataset": dataset.key}
    return RunRecord(
        id=digest(identity)[:16],
        status="done",
        at=datetime.now(UTC).isoformat(timespec="seconds"),
        method=submission.method,
        config={},
        label={},
        dataset=dataset,
        run=identity["csv"],
        csv=submission.path.name,
        estimates=len(submission.rows),
        metrics=summary_of(result)["metrics"],
        scores=result.scores,
    )


def _pluralize(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
