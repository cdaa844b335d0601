"""One run: what was asked -> the graph's steps -> csv, records, overlays and a summary."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

import numpy as np
import torch
from pydantic import Field

from pipeline.bop.dataset import Dataset
from pipeline.errors import BadInput
from pipeline.graph import Context, Graph, Node, PoseEvaluation, ScoreNodes, use_threads
from pipeline.io.checkpoints import NotDownloaded
from pipeline.io.digests import DigestCache, use_digest_cache
from pipeline.items.poses import NoEstimate
from pipeline.items.records import Answer
from pipeline.items.scores import PoseErrors
from pipeline.items.views import Target
from pipeline.metrics.recall import THETAS
from pipeline.outputs import KEY_DIGITS, Outputs, now
from pipeline.progress import Progress, format_bytes
from pipeline.report.run_records import RunRecord, finished_run_record, read_run_records, run_id, write_run_record
from pipeline.report.scores import scores_table
from pipeline.report.summary import answers_table, failures_table, objects_table
from pipeline.route import Stages
from pipeline.scoring import Scorer
from pipeline.spec import NonNegative, PositiveFloat, Runtime, spec
from pipeline.store import Store

ROWS_SHOWN = 48  # a longer table goes to poses.json alone; the terminal shows one line per object


class DatasetSource(Protocol):
    """What a dataset yaml configures."""

    def open(self) -> Dataset:
        """The dataset, checked. Raises BadInput."""
        ...


@spec
class Select:
    """Part of the targets; None: all."""

    objects: tuple[int, ...] | None = None
    scenes: tuple[int, ...] | None = None
    images: tuple[int, ...] | None = None

    def of(self, dataset: Dataset) -> tuple[Target, ...]:
        """The chosen targets. Raises BadInput naming what there is when a choice leaves nothing."""
        chosen = dataset.targets
        for name, field in (("scenes", "scene_id"), ("images", "im_id"), ("objects", "obj_id")):
            wanted, there = getattr(self, name), sorted({getattr(target, field) for target in chosen})
            if wanted is None:
                continue
            chosen = tuple(target for target in chosen if getattr(target, field) in wanted)
            if not chosen:
                listed = ", ".join(map(str, there[:20])) + (", ..." if len(there) > 20 else "")
                raise BadInput(f"select.{name}", found=list(wanted), needed=f"some of the targets' {name}: {listed}")
        return chosen


@spec
class Evaluate:
    """How poses are scored. ``models``: folder of the meshes errors are measured on, the dataset's where it is missing.

    ``vsd_delta_mm``: how much deeper than the depth image a surface may lie and still count as visible (BOP: 15).
    ``theta_max``: thresholds above it are left out of the averages. ``correspondences``: judge them as well.
    """

    vsd: bool = True
    vsd_delta_mm: PositiveFloat = 15.0
    models: str = "models_eval"
    theta_max: Annotated[float, Field(ge=0.05, le=0.5)] = 0.5
    correspondences: bool = False


@spec
class Options:
    """What to do and where to write.

    ``label``: the variant of every stage; ``config``: the whole configuration; ``resume``: leave a run alone whose row
    says that it has ended well (jobs of sweeps).
    """

    step: Literal["all", "onboard", "detect", "estimate", "evaluate", "report"]
    plan: bool
    out: str
    overlays: bool
    gallery: NonNegative
    sweep: str | None
    evaluate: Evaluate
    threads: NonNegative
    method: str
    select: Select
    label: Mapping[str, str]
    config: Mapping[str, Any]
    resume: bool = False

    @property
    def name(self) -> str:
        """The method's name in csv files: no underscores, as BOP asks."""
        return f"{self.method}-{self.label['extract']}".replace("_", "-")


def run(*, stages: Stages, dataset: DatasetSource, store: Store, runtime: Runtime, options: Options) -> None:
    """Run one configuration. Raises DzopError for whatever a user can mend; prints what was done and where it lies."""
    start = time.perf_counter()
    use_threads(options.threads)
    data = dataset.open()
    targets = options.select.of(data)
    context = Context(stages, data, targets, store, runtime, Progress(runtime.progress))
    folder = store.backend.folder
    digests = None if folder is None else DigestCache(folder / ".digests")
    with use_digest_cache(digests), runtime.workers(context, threads=options.threads) as context.workers:
        graph = Graph(context)
        if options.plan:
            _plan(graph, options)
            return
        _steps(graph, options)
    seconds = time.perf_counter() - start
    print(f"\n{context.progress.table()}\n{'whole run':<20}{'':>20}{seconds:>10.1f}", flush=True)


def _steps(graph: Graph, options: Options) -> None:
    """The steps asked for."""
    graph.check()
    graph.hold_to_vram()
    run = graph.context
    print(_headline(options, run.stages, run.dataset, run.targets, run.store), flush=True)
    try:
        if options.step == "onboard":
            graph.onboard()
        elif options.step == "detect":
            _detect(graph, options)
        else:
            _estimate(graph, options)
    except torch.cuda.OutOfMemoryError as error:
        needed = "a smaller runtime.batch (0 = sized to memory), extract.dtype=float16, or more in runtime.max_vram"
        raise BadInput(f"memory of {run.device}", found=" ".join(str(error).split())[:200], needed=needed) from None
    finally:
        run.timings.save()


def _plan(graph: Graph, options: Options) -> None:
    """Every node, and what the missing ones will cost; nothing is computed and nothing fetched."""
    run, unknown = graph.context, None
    nodes: list[Node] = []
    try:
        graph.check()
        print(_headline(options, run.stages, run.dataset, run.targets, run.store), flush=True)
    except NotDownloaded as fault:
        unknown = fault
    try:
        for node in graph.planned():
            nodes.append(node)  # one by one: those before an unknown one are kept
        if (scores := _scores(graph, options)) and graph.detections.known:
            nodes.append(scores.node())
    except NotDownloaded as fault:
        unknown = fault
    print(plan_table(nodes))
    if unknown is not None:
        print(f"{unknown}; what follows from these weights is not listed")
        return
    print(costs_text(nodes))
    here, on_device = graph.memory(passes=any(node.passes for node in nodes))
    print(f"memory  at the peak about {here.text()}")
    if on_device is not None:
        print(f"vram    at the peak about {on_device.text()}")


def _detect(graph: Graph, options: Options) -> None:
    """Detections, and their file where they were not read from one."""
    if graph.detections.proposals:
        _check_folder(Path(options.out))
    found = graph.detect()
    without = [d for d in found if d.defect is not None]
    print(f"{len(found) - len(without)} detections")
    for d in without[:ROWS_SHOWN]:
        print(f"object {d.obj_id} in scene {d.scene_id}, image {d.im_id}: {d.defect}")
    if graph.detections.proposals:
        print(f"written   {_outputs(graph, None, options).write_detections()}")


def _outputs(graph: Graph, scores: ScoreNodes | None, options: Options) -> Outputs:
    theta_max = options.evaluate.theta_max
    return Outputs(
        graph, scores, Path(options.out), options.name, options.config, options.label, options.sweep, theta_max
    )


def _estimate(graph: Graph, options: Options) -> None:
    """Poses, and unless they alone are asked for, their scores; files, pictures and tables of both."""
    _check_folder(Path(options.out))
    scores = _scores(graph, options)
    outputs, theta_max = _outputs(graph, scores, options), options.evaluate.theta_max
    if options.resume and scores is not None and outputs.finished():
        print(f"finished before: {outputs.run_record_path}")
        return
    for doubt in (odd := graph.warnings())[:ROWS_SHOWN]:
        print(f"warning: {doubt}", flush=True)
    answers = graph.estimate()
    judged = None if scores is None else scores.evaluate(answers)
    outputs.write_files(answers, judged, odd)
    if options.overlays:
        outputs.draw_overlays(answers, judged)
    _show(answers, judged, theta_max=theta_max)
    print(outputs.places(overlays=options.overlays))
    if judged is not None:
        cases = outputs.draw_gallery(answers, judged, options.gallery)
        outputs.write_run_record(answers, judged, cases)


def _check_folder(out: Path) -> None:
    """Raise BadInput where results could not be written, before anything is computed."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput("out", found=f"{out} ({error.strerror})", needed="a folder to write to") from None


def _scores(graph: Graph, options: Options) -> ScoreNodes | None:
    """The node of the run's scores, None where poses alone are asked for or nothing is annotated."""
    data, chosen = graph.context.dataset, options.evaluate
    if options.step == "estimate":
        return None
    if not np.isclose(THETAS, chosen.theta_max).any():
        needed = f"one of BOP's thresholds: {', '.join(f'{theta:g}' for theta in THETAS)}"
        raise BadInput("evaluate.theta_max", found=chosen.theta_max, needed=needed)
    bare = sorted({t.scene_id for t in graph.context.targets if not data.has_ground_truth(t.scene_id)})
    if bare:
        if options.step == "evaluate":
            where = data.root / data.split / f"{bare[0]:06d}"
            raise BadInput(where, found="no scene_gt.json", needed="ground truth to evaluate against, or step=estimate")
        return None
    there = (data.root / chosen.models).is_dir()
    if not there and chosen.models != Evaluate.models:
        raise BadInput(
            data.root / chosen.models, found="no such folder", needed="the meshes that evaluate.models names"
        )
    models = chosen.models if there else data.models
    scorer = Scorer(data, graph.context.targets, models, vsd_delta_mm=chosen.vsd_delta_mm, with_vsd=chosen.vsd)
    return graph.scores(scorer, correspondences=chosen.correspondences)


def _show(answers: Sequence[Answer], judged: PoseEvaluation | None, *, theta_max: float) -> None:
    """Tables for the terminal."""
    errors: Sequence[PoseErrors | None] = [None] * len(answers) if judged is None else judged.by_answer
    rows = list(zip(answers, errors, strict=True))
    print("\n" + (answers_table(rows) if len(rows) <= ROWS_SHOWN else objects_table(rows)))
    missing = [answer for answer in answers if isinstance(answer, NoEstimate)]
    if missing:
        print("\n" + failures_table(missing))
    reasons = " (each with its reason)" if missing else ""
    print(f"\n{len(answers) - len(missing)} poses, {len(missing)} without{reasons}")
    if judged is not None:
        print(scores_table(judged.scored, theta_max=theta_max))
        if judged.correspondences:
            error = np.median(list(judged.correspondences.values()))
            print(f"correspondences: median {error:.1%} of the diameter off, parallel to the image")


def _headline(options: Options, stages: Stages, data: Dataset, targets: Sequence[Target], store: Store) -> str:
    objects, images = len({t.obj_id for t in targets}), len({(t.scene_id, t.im_id) for t in targets})
    lines = [
        f"{options.name} on {data.name} {data.split}: {len(targets)} targets, {images} images, {objects} objects",
        f"renderer {stages.render.kind.split('.')[-1]}, features {stages.extract.model}, store {store.place}",
    ]
    return "\n".join([*lines, *filter(None, [stages.extract.notice])])


def plan_table(nodes: Sequence[Node]) -> str:
    """A line per node, then sums by state."""
    lines = [f"{'state':<9}{'size':>10}  {'key':<{KEY_DIGITS}}  node"]
    for node in nodes:
        cost = f"  ({node.cost})" if node.cost else ""
        lines.append(
            f"{node.state:<9}{format_bytes(node.nbytes):>10}  {node.ref.key[:KEY_DIGITS]}  {node.step}: {node.of}{cost}"
        )
    for state in sorted({node.state for node in nodes}):
        mine = [node for node in nodes if node.state == state]
        lines.append(f"{len(mine)} nodes {state}, {format_bytes(sum(node.nbytes for node in mine))}")
    return "\n".join(lines)


def costs_text(nodes: Sequence[Node]) -> str:
    """What the nodes that are not cached will write, pass through backbones, and take in time."""
    missing = [node for node in nodes if node.state != "cached"]
    exact = sum(node.nbytes for node in missing if "crops" not in node.step and node.step != "templates")
    packed = sum(node.nbytes for node in missing if node.sized) - exact
    steps = dict.fromkeys(node.step for node in missing)
    small = [step for step in steps if any(node.step == step and not node.sized for node in missing)]
    told, unknown = [], []
    for step in steps:
        seconds = [node.seconds for node in missing if node.step == step]
        known = [s for s in seconds if s is not None]
        if known and len(known) == len(seconds):
            told.append((step, sum(known)))
        else:
            unknown.append(step)
    parts = ", ".join(f"{step} {duration(seconds)}" for step, seconds in told)
    time_ = f"{duration(sum(s for _, s in told))} ({parts})" if told else "nothing to compute"
    if unknown:
        time_ = f"{time_} and " if told else ""
        time_ += f"unknown for {', '.join(unknown)}: not measured on this machine in this store"
    disk = f"{format_bytes(exact)} of features and fits"
    disk += f", at most {format_bytes(packed)} of templates and crops (compressed)"
    disk += f", and the records of {', '.join(small)}" if small else ""
    return (
        f"disk    {disk}\npasses  {sum(node.passes for node in missing)} images through the backbone\ntime    {time_}"
    )


def duration(seconds: float) -> str:
    """Seconds in a unit a person reads."""
    if seconds < 120:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.1f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def note_failure(out: str, config: Mapping[str, Any], overrides: Sequence[str], message: str) -> None:
    """Leave a row that says that a job failed and why, unless the same configuration has ended well before."""
    id_ = run_id(config)
    if finished_run_record(Path(out), id_) is not None:
        return
    row = RunRecord(
        id=id_,
        status="failed",
        at=now(),
        method=str(config.get("method", "")),
        config=config,
        label={},
        error=message,
        overrides=tuple(overrides),
        sweep=str(config.get("sweep") or ""),
    )
    write_run_record(Path(out), row)


def make_report(out: str) -> None:
    """The report of all rows below ``out``. Raises BadInput where there is none."""
    from pipeline.report.page import write_report  # matplotlib, which no other step needs

    made = write_report(read_run_records(Path(out)), Path(out))
    print(made.summary)
