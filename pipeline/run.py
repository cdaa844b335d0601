"""Run one configuration: compute the steps that were asked for, write their files and print a summary."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
import torch

from pipeline.bop.dataset import Dataset
from pipeline.bop.given import GivenObjects
from pipeline.bop.results import results_name
from pipeline.confidence.calibration import choose_calibration, describe_confidence
from pipeline.errors import BadInput, DzopError
from pipeline.graph import Context, Graph, Node, PoseEvaluation, ScoreNodes, plan_costs, plan_table
from pipeline.io.checkpoints import NotDownloaded
from pipeline.io.digests import DigestCache, track_files
from pipeline.items.poses import NoEstimate, PoseEstimate
from pipeline.items.records import Answer
from pipeline.method import Stages
from pipeline.metrics.reliability import calibration_error, ranking_auc
from pipeline.options import Options
from pipeline.outputs.files import errors_by_answer, places_text, write_computed_detections, write_files
from pipeline.outputs.folder import OutputFolder
from pipeline.outputs.photographs import Photographs
from pipeline.outputs.pictures import Pictures
from pipeline.outputs.records import confidences_of, digest_answers, write_record
from pipeline.parallel import use_threads
from pipeline.progress import Progress
from pipeline.report.run_records import read_run_records
from pipeline.report.scores import scores_table
from pipeline.report.summary import answers_table, counts_text, failures_table, objects_table
from pipeline.scoring import Scorer
from pipeline.spec import Runtime
from pipeline.store import Store

MAX_REASONS = 4  # in the error about a photograph without a pose
MAX_ROWS = 48  # the terminal shows longer tables by object; poses.json has every row


class DatasetSource(Protocol):
    """What a dataset yaml configures."""

    def open(self) -> Dataset:
        """Open and check the dataset. Raises BadInput."""
        ...


def run(*, stages: Stages, dataset: DatasetSource, store: Store, runtime: Runtime, options: Options) -> str:
    """Run one configuration and print what was done and where the results are. Raises DzopError.

    Returns the digest of the answers, "" for a run that gives none.
    """
    start = time.perf_counter()
    use_threads(options.threads)
    # Names that no results file can have are refused now, not when everything is computed.
    results_name(options.file_name, getattr(dataset, "name", "data"), getattr(dataset, "split", "test"))
    folder = store.backend.folder
    with track_files(None if folder is None else DigestCache(folder / ".digests")):
        data = dataset.open()
        targets, progress = options.select.targets(data), Progress(runtime.progress)
        calibration = choose_calibration(stages, options.confidence)
        context = Context(stages, data, targets, store, runtime, progress, calibration=calibration)
        with store.in_use(), runtime.start_workers(context, threads=options.threads) as context.workers:
            graph = Graph(context)
            if options.plan:
                _print_plan(graph, options)
                return ""
            answers = _run_step(graph, options)
    seconds = time.perf_counter() - start
    print(f"\n{context.progress.table()}\n{'total':<20}{'':>20}{seconds:>10.1f}", flush=True)
    return answers


def make_report(out: str) -> None:
    """Write the report of all runs below ``out``. Raises BadInput if there are none."""
    from pipeline.report.page import write_report  # imports matplotlib, which no other step needs

    print(write_report(read_run_records(Path(out)), Path(out)).summary)


def _run_step(graph: Graph, options: Options) -> str:
    """Check the configuration, then compute the step that was asked for and whatever it needs. Returns as ``run``."""
    graph.check()
    graph.limit_vram()
    print(_headline(graph.context, options), flush=True)
    try:
        if options.step == "onboard":
            _print_warnings(graph.mesh_warnings())
            graph.onboard()
        elif options.step == "detect":
            _detect(graph, options)
        else:
            return _estimate(graph, options)
        return ""
    except torch.cuda.OutOfMemoryError as error:
        needed = "a smaller runtime.batch (0 = sized to memory), extract.dtype=float16, or a larger runtime.max_vram"
        found = " ".join(str(error).split())[:200]
        raise BadInput(f"memory of {graph.context.device}", found=found, needed=needed) from None
    finally:
        graph.context.timings.save()


def _print_plan(graph: Graph, options: Options) -> None:
    """Print every node and the cost of the missing ones. Computes nothing and downloads nothing.

    Keys that depend on weights that are not on this machine are unknown: the nodes before them are listed.
    """
    nodes: list[Node] = []
    not_downloaded: NotDownloaded | None = None
    try:
        graph.check()
        print(_headline(graph.context, options), flush=True)
    except NotDownloaded as error:
        not_downloaded = error
    _print_warnings(graph.mesh_warnings())
    try:
        for node in graph.plan():
            nodes.append(node)
        if (scores := _score_nodes(graph, options)) and graph.detections.known:
            nodes.append(scores.node())
    except NotDownloaded as error:
        not_downloaded = error
    print(plan_table(nodes))
    if not_downloaded is not None:
        print(f"{not_downloaded}; nodes that depend on these weights are not listed")
        return
    print(plan_costs(nodes))
    machine, device = graph.memory(passes=any(node.passes for node in nodes))
    print(f"memory  peak of about {machine.text()}")
    if device is not None:
        print(f"vram    peak of about {device.text()}")


def _detect(graph: Graph, options: Options) -> None:
    """Detect the targets, and write the detections if they were computed rather than read from a file."""
    if graph.detections.computed:
        _make_folder(Path(options.out))
    detections = graph.detect()
    _print_warnings(graph.detection_warnings())
    unusable = [d for d in detections if d.defect is not None]
    print(f"{len(detections) - len(unusable)} detections")
    for d in unusable[:MAX_ROWS]:
        print(f"object {d.obj_id} in scene {d.scene_id}, image {d.im_id}: {d.defect}")
    if graph.detections.computed:
        print(f"written   {write_computed_detections(OutputFolder(graph, None, options))}")


def _estimate(graph: Graph, options: Options) -> str:
    """Estimate and, unless step=estimate, score the poses; write their files and pictures and print their tables.

    Returns the digest of the answers.
    """
    _make_folder(Path(options.out))
    scores = _score_nodes(graph, options)
    folder = OutputFolder(graph, scores, options)
    if options.resume and scores is not None and folder.is_finished():
        print(f"already finished: {folder.record}")
        before = folder.earlier_record()
        return before.answers if before else ""
    warnings = graph.warnings()
    _print_warnings(warnings)
    answers = graph.estimate()
    evaluation = None if scores is None else scores.evaluate(answers)
    write_files(folder, answers, evaluation, warnings)
    pictures = Pictures(folder, answers, evaluation)
    if options.overlays:
        pictures.draw_overlays()
    if isinstance(folder.context.dataset, GivenObjects):
        written = _write_photographs(Photographs(folder, pictures, answers, warnings))
    else:
        written = []
        _print_results(answers, evaluation, folder.context, options)
    _print_warnings(warnings)
    print(places_text(folder, written, overlays=options.overlays))
    if evaluation is not None:
        cases = pictures.draw_gallery(options.gallery)
        print(f"record    {write_record(folder, answers, evaluation, cases)}")
    if graph.context.dataset.requires_pose:
        _require_pose(answers)
    return digest_answers(answers)


def _require_pose(answers: Sequence[Answer]) -> None:
    """Raise DzopError if no answer is a pose; files and pictures are written by then."""
    missing = [answer for answer in answers if isinstance(answer, NoEstimate)]
    if len(missing) == len(answers):
        reasons = "; ".join(f"object {a.obj_id}: {a.stage}: {a.reason}" for a in missing[:MAX_REASONS])
        raise DzopError(f"found no pose, needs one ({reasons}); poses.json has the reasons")


def _print_warnings(warnings: Sequence[str]) -> None:
    """Warnings are printed before the poses are estimated and again after them, where a reader looks."""
    for warning in warnings[:MAX_ROWS]:
        print(f"warning: {warning}", flush=True)


def _make_folder(out: Path) -> None:
    """Create the results folder before anything is computed. Raises BadInput."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput("out", found=f"{out} ({error.strerror})", needed="a folder to write to") from None


def _score_nodes(graph: Graph, options: Options) -> ScoreNodes | None:
    """The node of the run's scores; None for step=estimate and without ground truth."""
    data, targets = graph.context.dataset, graph.context.targets
    if options.step == "estimate":
        return None
    options.evaluate.check_theta_max()
    not_annotated = sorted({t.scene_id for t in targets if not data.has_ground_truth(t.scene_id)})
    if not_annotated:
        if options.step == "evaluate":
            where = data.root / data.split / f"{not_annotated[0]:06d}"
            raise BadInput(where, found="no scene_gt.json", needed="ground truth to evaluate against, or step=estimate")
        return None
    models, evaluate = options.evaluate.models_folder(data), options.evaluate
    scorer = Scorer(data, targets, models, vsd_delta_mm=evaluate.vsd_delta_mm, with_vsd=evaluate.vsd)
    return graph.scores(scorer, correspondences=evaluate.correspondences)


def _print_results(
    answers: Sequence[Answer], evaluation: PoseEvaluation | None, context: Context, options: Options
) -> None:
    rows = list(zip(answers, errors_by_answer(answers, evaluation), strict=True))
    print("\n" + (answers_table(rows) if len(rows) <= MAX_ROWS else objects_table(rows)))
    failures = [answer for answer in answers if isinstance(answer, NoEstimate)]
    if failures:
        print("\n" + failures_table(failures))
    print(f"\n{counts_text(answers)}")
    print(_decisions_text(answers, context, options.confidence))
    if evaluation is None:
        return
    print(f"\nscores on {context.stages.detect.summary}")
    print(scores_table(evaluation.scored, theta_max=options.evaluate.theta_max).lstrip("\n"))
    if found := confidences_of(answers, evaluation):
        confidence, right = np.array([c for c, _ in found]), np.array([r for _, r in found])
        error, auc = calibration_error(confidence, right), ranking_auc(confidence, right)
        print(f"confidence: AUC {auc:.3f}, calibration error {error:.1%}")
    if evaluation.correspondences:
        median = np.median(list(evaluation.correspondences.values()))
        print(f"correspondences: median error {median:.1%} of the diameter, parallel to the image plane")


def _write_photographs(photographs: Photographs) -> list[Path]:
    """Write the folder of every photograph and print the results; returns the folders."""
    context, options = photographs.folder.context, photographs.folder.options
    written = photographs.write(overlays=options.overlays, cards=options.gallery > 0)
    print(f"\n{photographs.text()}\n\n{counts_text(photographs.answers)}")
    if note := describe_confidence(context.stages, context.calibration, options.confidence):
        print(note)
    return written


def _decisions_text(answers: Sequence[Answer], context: Context, choice: str) -> str:
    """How many poses are to be accepted, checked and rejected, or why that is unknown."""
    estimates = [answer for answer in answers if isinstance(answer, PoseEstimate)]
    note = describe_confidence(context.stages, context.calibration, choice)
    if context.calibration is None:
        return note or "confidence: none, as asked for"
    counts = Counter(estimate.decision for estimate in estimates)
    text = ", ".join(f"{name} {counts[name]}" for name in ("accept", "check", "reject"))
    return "\n".join([f"decisions: {text}", *filter(None, [note])])


def _headline(context: Context, options: Options) -> str:
    data, stages, targets = context.dataset, context.stages, context.targets
    objects, images = len(context.object_ids), len(context.image_ids)
    renderer = stages.render.kind.split(".")[-1]
    lines = [
        f"{options.name} on {data.name} {data.split}: {len(targets)} targets, {images} images, {objects} objects",
        f"{stages.detect.summary}, renderer {renderer}, features {stages.extract.model}, store {context.store.place}",
    ]
    return "\n".join([*lines, *filter(None, [stages.extract.notice])])
