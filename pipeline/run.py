"""One run: what was asked -> the graph's steps -> csv, records, overlays and a summary."""

from __future__ import annotations

import json
import os
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import cv2
import torch

from pipeline.bop.dataset import Dataset
from pipeline.bop.results import results_name, rows_of, write_results
from pipeline.digests import remember_in
from pipeline.errors import BadInput
from pipeline.graph import Context, Graph, Node
from pipeline.items.poses import NoEstimate, PoseEstimate
from pipeline.items.records import Answer, record_of
from pipeline.items.views import Target
from pipeline.metrics.judge import CORRECT_MSSD, Judged, judge
from pipeline.report.overlay import Drawn, draw_overlay, write_overlay
from pipeline.report.summary import answers_table, failures_table, objects_table
from pipeline.route import Stages
from pipeline.spec import NonNegative, Runtime, spec
from pipeline.store import Store
from pipeline.tally import Tally, human

KEY_DIGITS = 12
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
class Options:
    """What to do and where to write. ``label``: the variant of every stage; ``config``: the whole configuration."""

    step: Literal["all", "onboard", "detect", "estimate"]
    plan: bool
    out: str
    overlays: bool
    threads: NonNegative
    method: str
    select: Select
    label: Mapping[str, str]
    config: Mapping[str, Any]

    @property
    def name(self) -> str:
        """The method's name in csv files: no underscores, as BOP asks."""
        return f"{self.method}-{self.label['extract']}".replace("_", "-")


@dataclass(frozen=True)
class Checked:
    """An answer and, where there is ground truth and a pose, its errors."""

    answer: Answer
    judged: Judged | None


def run(*, stages: Stages, dataset: DatasetSource, store: Store, runtime: Runtime, options: Options) -> None:
    """Run one configuration. Raises DzopError for whatever a user can mend; prints what was done and where it lies."""
    start = time.perf_counter()
    _use_threads(options.threads)
    remember_in(None if store.backend.folder is None else store.backend.folder / ".digests")
    data = dataset.open()
    targets = options.select.of(data)
    graph = Graph(Context(stages, data, targets, store, runtime, Tally(runtime.progress)))
    graph.check()
    print(_headline(options, stages, data, targets, store), flush=True)
    if options.plan:
        print(plan_table(graph.plan()))
        return
    if options.step == "onboard":
        graph.onboard()
    elif options.step == "detect":
        print(f"{graph.detect()} detections")
    else:
        _estimate(graph, options)
    print(f"\n{graph.run.tally.table()}\n{'whole run':<20}{'':>20}{time.perf_counter() - start:>10.1f}", flush=True)


def _use_threads(threads: int) -> None:
    if threads:
        torch.set_num_threads(threads)
        cv2.setNumThreads(threads)


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
            f"{node.state:<9}{human(node.nbytes):>10}  {node.ref.key[:KEY_DIGITS]}  {node.step}: {node.of}{cost}"
        )
    for state in sorted({node.state for node in nodes}):
        mine = [node for node in nodes if node.state == state]
        lines.append(f"{len(mine)} nodes {state}, {human(sum(node.nbytes for node in mine))}")
    return "\n".join(lines)


def _estimate(graph: Graph, options: Options) -> None:
    answers = graph.estimate()
    checked = [Checked(answer, _judged(graph, answer)) for answer in answers]
    data, key = graph.run.dataset, graph.poses.run_ref().key
    csv = results_name(options.name, data.name, data.split)
    folder = Path(options.out) / csv.removesuffix(".csv") / key[:KEY_DIGITS]
    estimates = [answer for answer in answers if isinstance(answer, PoseEstimate)]
    write_results(folder / csv, rows_of(estimates, _seconds_by_image(answers)))
    _write_record(folder / "poses.json", graph, options, checked)
    if options.overlays:
        _draw(graph, checked, folder / "overlays")
    missing = [answer for answer in answers if isinstance(answer, NoEstimate)]
    rows = [(c.answer, c.judged) for c in checked]
    print("\n" + (answers_table(rows) if len(rows) <= ROWS_SHOWN else objects_table(rows)))
    if missing:
        print("\n" + failures_table(missing))
    print(f"\n{len(estimates)} poses, {len(missing)} without (each with its reason)")
    print(f"csv       {folder / csv}\nrecords   {folder / 'poses.json'}")
    if options.overlays:
        compared = any(c.judged for c in checked)
        meaning = f"ground truth blue; green: MSSD < {CORRECT_MSSD:.0%} of the diameter" if compared else "estimates"
        print(f"overlays  {folder / 'overlays'}  ({meaning})")


def _judged(graph: Graph, answer: Answer) -> Judged | None:
    data = graph.run.dataset
    if isinstance(answer, NoEstimate) or not data.has_ground_truth(answer.scene_id):
        return None
    truths = {
        i: gt.T_cam_obj
        for i, gt in enumerate(data.ground_truth(answer.scene_id, answer.im_id))
        if gt.obj_id == answer.obj_id
    }
    return judge(answer, truths, graph.run.model(answer.obj_id)) if truths else None


def _seconds_by_image(answers: Sequence[Answer]) -> dict[tuple[int, int], float]:
    """BOP's time of an image: all its detections together, features included."""
    seconds: defaultdict[tuple[int, int], float] = defaultdict(float)
    for answer in answers:
        if isinstance(answer, PoseEstimate):
            seconds[answer.scene_id, answer.im_id] += sum(answer.times_s.values())
    return dict(seconds)


def _write_record(path: Path, graph: Graph, options: Options, checked: Sequence[Checked]) -> None:
    answers = [record_of(c.answer) | {"errors": c.judged and c.judged.as_record()} for c in checked]
    record = {
        "run": graph.poses.run_ref().key,
        "method": options.name,
        "dataset": graph.run.dataset.name,
        "config": options.config,
        "counts": graph.run.tally.as_record(),
        "answers": answers,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    partial.write_text(json.dumps(record, indent=1, allow_nan=False))
    partial.replace(path)


def _draw(graph: Graph, checked: Sequence[Checked], folder: Path) -> None:
    by_image: defaultdict[tuple[int, int], list[Checked]] = defaultdict(list)
    for c in checked:
        by_image[c.answer.scene_id, c.answer.im_id].append(c)
    start, drawn = time.perf_counter(), 0
    with graph.run.tally.bar(len(by_image), "overlays", "image") as advance:
        for (scene_id, im_id), shown in sorted(by_image.items()):
            path = folder / f"{scene_id:06d}_{im_id:06d}.jpg"
            if not path.exists():  # the folder's name is the key of all that is drawn
                picture = draw_overlay(graph.run.dataset.image(scene_id, im_id), _drawn(graph, shown))
                write_overlay(path, picture)
                drawn += 1
            advance(1)
    seconds = time.perf_counter() - start
    graph.run.tally.add("overlays", computed=drawn, reused=len(by_image) - drawn, time_s=seconds)


def _drawn(graph: Graph, shown: Sequence[Checked]) -> list[Drawn]:
    """Ground truth of the image's targets, and every estimate."""
    data, first = graph.run.dataset, shown[0].answer
    asked = {c.answer.obj_id for c in shown}
    truths = data.ground_truth(first.scene_id, first.im_id) if data.has_ground_truth(first.scene_id) else []
    drawn = [Drawn(graph.run.model(gt.obj_id).mesh, gt.T_cam_obj, "truth") for gt in truths if gt.obj_id in asked]
    for c in shown:
        if isinstance(c.answer, PoseEstimate):
            label = f"{c.answer.obj_id}: {c.answer.score:.2f}"
            drawn.append(Drawn(graph.run.model(c.answer.obj_id).mesh, c.answer.T_cam_obj, _role(c.judged), label))
    return drawn


def _role(judged: Judged | None) -> Literal["correct", "wrong", "unchecked"]:
    if judged is None:
        return "unchecked"
    return "correct" if judged.correct else "wrong"
