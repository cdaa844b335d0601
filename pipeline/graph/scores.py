"""poses, ground truth -> scores of a run: one entry, made once for every set of poses."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pipeline.bop.results import ResultRow
from pipeline.graph.context import Context
from pipeline.graph.plan import Node
from pipeline.graph.poses import PoseNodes
from pipeline.graph.replay import Retracer
from pipeline.graph.templates import TemplateNodes
from pipeline.io.digests import files_digest
from pipeline.items.poses import PoseEstimate
from pipeline.items.records import Answer
from pipeline.items.scores import (
    PoseErrors,
    TemplateError,
    errors_from_record,
    errors_to_record,
    scores_from_record,
    scores_to_record,
)
from pipeline.metrics.correspondence_error import correspondence_errors_mm
from pipeline.metrics.template_error import template_error
from pipeline.scoring import SCORES_VERSION, Scorer, ScoringResult, truth_digest
from pipeline.spec import digest
from pipeline.store import Ref, make_ref

Instance = tuple[int, int, int, int]
"""(scene_id, im_id, obj_id, gt_id)"""


@dataclass(frozen=True, eq=False)
class PoseEvaluation:
    """A run's answers scored against the ground truth. ``by_answer[i]``: errors of answer i, None without an instance.

    ``correspondences``: median error of an instance's correspondences over its diameter, where they were asked for.
    """

    scored: ScoringResult
    by_answer: tuple[PoseErrors | None, ...]
    templates: Mapping[Instance, TemplateError]
    correspondences: Mapping[Instance, float]


@dataclass(eq=False)
class ScoreNodes:
    """The entry of a run's scores. ``scorer`` says what poses are held against; ``retrace`` shows correspondences.

    Without ``retrace`` they are not looked at.
    """

    context: Context
    templates: TemplateNodes
    poses: PoseNodes
    scorer: Scorer
    retrace: Retracer | None = None

    @cached_property
    def ref(self) -> Ref:
        """Scores of the run's poses."""
        scorer, data = self.scorer, self.context.dataset
        recipe = {"kind": "scores", "version": SCORES_VERSION, "vsd_delta_mm": scorer.vsd_delta_mm}
        recipe |= {"correspondences": True} if self.retrace else {}
        depth = "" if scorer.no_vsd else files_digest({str(image): data.depth_path(*image) for image in scorer.images})
        meshes = {str(obj_id): data.model_path(obj_id, folder=scorer.models) for obj_id in self.context.object_ids}
        info = data.model_path(0, folder=scorer.models).with_name("models_info.json")
        if info.exists():
            meshes["info"] = info
        inputs = {"poses": self.poses.run_ref().key, "truth": truth_digest(scorer), "depth": depth or scorer.no_vsd}
        return make_ref("scores", recipe, inputs | {"meshes": files_digest(meshes)})

    def node(self) -> Node:
        """The entry as a plan shows it."""
        state, targets = self.context.store.state(self.ref), len(self.context.targets)
        cost = "" if state == "cached" else f"{targets} targets to hold against ground truth"
        size, seconds = self.context.store.size(self.ref), self.context.timings.seconds(self._work, targets)
        if size is not None:
            return Node("scores", f"{targets} targets", self.ref, state, size, cost)
        return Node("scores", f"{targets} targets", self.ref, state, 0, cost, seconds=seconds, sized=False)

    @property
    def _work(self) -> str:
        """What decides the seconds of a target."""
        how = [self.scorer.vsd_delta_mm, not self.scorer.no_vsd, self.retrace is not None, self.scorer.models]
        return digest(["scores", self.context.dataset.name, how])

    def evaluate(self, answers: Sequence[Answer]) -> PoseEvaluation:
        """Scores of the run's answers, read or made."""
        fresh = not self.context.store.is_complete(self.ref)
        if fresh:
            self._make(answers)
        entry = self.context.store.read(self.ref)
        seconds = entry.time_s if fresh else 0.0
        self.context.progress.add("scores", **{"computed" if fresh else "reused": len(answers)}, time_s=seconds)
        errors = tuple(errors_from_record(record) for record in entry.document["errors"])
        templates = {(s, i, o, g): TemplateError(*angles) for s, i, o, g, *angles in entry.document["templates"]}
        return PoseEvaluation(
            ScoringResult(errors, scores_from_record(entry.document["scores"]), self.scorer.models),
            _by_answer(answers, errors),
            templates,
            {(s, i, o, g): error for s, i, o, g, error in entry.document.get("correspondences", [])},
        )

    def _make(self, answers: Sequence[Answer]) -> None:
        start = time.perf_counter()
        with self.context.progress.bar(len(self.scorer.images), "scores", "image") as advance:
            scored = self.scorer.score([row for _, row in _rows(answers)], progress=advance)
        of = _by_answer(answers, scored.errors)
        angles = {
            instance: error
            for answer, errors in zip(answers, of, strict=True)
            if (instance := _instance(answer, errors)) and (error := self._template_error(answer, instance))
        }
        document: dict[str, Any] = {
            "errors": [errors_to_record(errors) for errors in scored.errors],
            "scores": scores_to_record(scored.scores),
            "templates": [[*instance, *asdict(error).values()] for instance, error in angles.items()],
        }
        if self.retrace:
            document["correspondences"] = self._correspondence_errors(answers, of)
        self.context.store.put_document(self.ref, document, rows=len(answers), time_s=time.perf_counter() - start)
        self.context.timings.add(self._work, len(self.context.targets), time.perf_counter() - start)

    def _correspondence_errors(
        self, answers: Sequence[Answer], of: Sequence[PoseErrors | None]
    ) -> list[list[int | float]]:
        """Each instance with the median error of its answer's correspondences, over the diameter."""
        assert self.retrace is not None
        found: list[list[int | float]] = []
        with self.context.progress.bar(len(answers), "correspondences", "answer") as advance:
            for answer, errors in sorted(zip(answers, of, strict=True), key=lambda pair: pair[0].obj_id):
                advance(1)
                instance, traced = _instance(answer, errors), self.retrace(answer)
                best = traced and traced.hypothesis
                if instance is None or not best or best.points_obj is None or best.query_px_img is None:
                    continue
                scene_id, im_id, obj_id, gt_id = instance
                T_gt = self.context.dataset.ground_truth(scene_id, im_id)[gt_id].T_cam_obj
                model, K = self.scorer.mesh(obj_id).model, self.context.K((scene_id, im_id))
                off = correspondence_errors_mm(best.points_obj, best.query_px_img, K, T_gt, model.symmetries)
                if len(off):
                    found.append([*instance, float(np.median(off)) / model.diameter_mm])
        return found

    def _template_error(self, answer: Answer, instance: Instance) -> TemplateError | None:
        """How far the template that was matched lies from the true view; None where none was."""
        if answer.template_id is None:
            return None
        scene_id, im_id, obj_id, gt_id = instance
        T_template = self.templates.read_views(obj_id, [answer.template_id]).T_cam_obj[0]
        T_gt = self.context.dataset.ground_truth(scene_id, im_id)[gt_id].T_cam_obj
        return template_error(T_template, T_gt, self.scorer.mesh(obj_id).model.symmetries)


def _rows(answers: Sequence[Answer]) -> list[tuple[int, ResultRow]]:
    """The estimates among the answers as rows of results, each with its answer's index."""
    return [
        (index, ResultRow(a.scene_id, a.im_id, a.obj_id, a.score, a.T_cam_obj, -1.0))
        for index, a in enumerate(answers)
        if isinstance(a, PoseEstimate)
    ]


def _by_answer(answers: Sequence[Answer], errors: Sequence[PoseErrors]) -> tuple[PoseErrors | None, ...]:
    """Errors of each answer against the instance its detection was made of, otherwise the one with least MSSD."""
    by_row: defaultdict[int, list[PoseErrors]] = defaultdict(list)
    for error in errors:
        by_row[error.row].append(error)
    found: list[PoseErrors | None] = [None] * len(answers)
    for row, (index, _) in enumerate(_rows(answers)):
        own = [e for e in by_row[row] if e.gt_id == answers[index].gt_id] or by_row[row]
        found[index] = min(own, key=lambda e: e.mssd_mm, default=None)
    return tuple(found)


def _instance(answer: Answer, errors: PoseErrors | None) -> Instance | None:
    """The annotated instance an answer is of, None where nothing says which."""
    gt_id = errors.gt_id if answer.gt_id is None and errors is not None else answer.gt_id
    return None if gt_id is None else (answer.scene_id, answer.im_id, answer.obj_id, gt_id)
