"""poses, ground truth -> scores. One entry per run."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.bop.images import image_digest
from pipeline.bop.results import ResultRow
from pipeline.graph.context import Context
from pipeline.graph.plan import Node
from pipeline.graph.poses import PoseNodes
from pipeline.graph.replay import Replayer
from pipeline.graph.templates import TemplateNodes
from pipeline.io.digests import file_exists, files_digest
from pipeline.items.errors import PoseErrors, TemplateError
from pipeline.items.online import Hypothesis
from pipeline.items.poses import PoseEstimate
from pipeline.items.records import Answer, errors_from_record, errors_to_record, scores_from_record, scores_to_record
from pipeline.metrics.correspondence_error import correspondence_errors_mm
from pipeline.metrics.template_error import template_error
from pipeline.parallel import one_thread_per_kernel
from pipeline.scoring import SCORES_VERSION, Scorer, ScoringResult, truth_digest
from pipeline.spec import digest
from pipeline.stages.render.raycast import DEPTH_VERSION
from pipeline.store import Ref, make_ref

Instance = tuple[int, int, int, int]
"""(scene_id, im_id, obj_id, gt_id)"""


@dataclass(frozen=True, eq=False)
class PoseEvaluation:
    """A run's answers scored against the ground truth.

    ``by_answer[i]``: errors of answer i, None without a pose or an instance. ``templates``: angles between the matched
    template and the true view. ``correspondences``: median error over the diameter, if requested.
    """

    scored: ScoringResult
    by_answer: tuple[PoseErrors | None, ...]
    templates: Mapping[Instance, TemplateError]
    correspondences: Mapping[Instance, float]


@dataclass(eq=False)
class ScoreNodes:
    """The entry of a run's scores. ``replayer`` recomputes correspondences; None leaves them out of the scores."""

    context: Context
    templates: TemplateNodes
    poses: PoseNodes
    scorer: Scorer
    replayer: Replayer | None = None

    @cached_property
    def ref(self) -> Ref:
        """Scores of the run's poses."""
        scorer, data = self.scorer, self.context.dataset
        recipe = {"kind": "scores", "version": SCORES_VERSION, "vsd_delta_mm": scorer.vsd_delta_mm}
        recipe |= {"correspondences": True} if self.replayer else {}
        meshes = {str(obj_id): data.model_path(obj_id, folder=scorer.models) for obj_id in self.context.object_ids}
        info = data.model_path(0, folder=scorer.models).with_name("models_info.json")
        if file_exists(info):
            meshes["info"] = info
        inputs = {"poses": self.poses.run_ref().key, "truth": truth_digest(scorer), "depth": self._depth_digest()}
        return make_ref("scores", recipe, inputs | {"meshes": files_digest(meshes)})

    def _depth_digest(self) -> str:
        """Digest of the measured depth and the version of VSD; without depth, the reason why VSD is not computed."""
        scorer, data = self.scorer, self.context.dataset
        if scorer.no_vsd:
            return scorer.no_vsd
        files = [image_digest(data.depth_path(*image), photograph=False) for image in scorer.images]
        scales = [data.scene(scene_id).camera(im_id).depth_scale for scene_id, im_id in scorer.images]
        return digest([files, scales, DEPTH_VERSION])

    def node(self) -> Node:
        """The entry as a plan shows it."""
        store, targets = self.context.store, len(self.context.targets)
        state, size, of = store.state(self.ref), store.size(self.ref), f"{targets} targets"
        cost = "" if state == "cached" else f"{targets} targets to score against ground truth"
        if size is not None:
            return Node("scores", of, self.ref, state, size, cost)
        seconds = self.context.timings.seconds(self._timing_key, targets)
        return Node("scores", of, self.ref, state, 0, cost, seconds=seconds, sized=False)

    @property
    def _timing_key(self) -> str:
        """Digest of everything that the seconds per target depend on."""
        scorer = self.scorer
        settings = [scorer.vsd_delta_mm, not scorer.no_vsd, self.replayer is not None, scorer.models]
        return digest(["scores", self.context.dataset.name, settings])

    def evaluate(self, answers: Sequence[Answer]) -> PoseEvaluation:
        """Scores of the run's answers, read from the store or computed."""
        is_new = not self.context.store.is_complete(self.ref)
        if is_new:
            self._compute(answers)
        entry = self.context.store.read(self.ref)
        counts = {"computed" if is_new else "reused": len(answers)}
        self.context.progress.add("scores", **counts, time_s=entry.time_s if is_new else 0.0)
        document = entry.document
        errors = tuple(errors_from_record(record) for record in document["errors"])
        return PoseEvaluation(
            scored=ScoringResult(errors, scores_from_record(document["scores"]), self.scorer.models),
            by_answer=_group_by_answer(answers, errors),
            templates={(s, i, o, g): TemplateError(*angles) for s, i, o, g, *angles in document["templates"]},
            correspondences={(s, i, o, g): error for s, i, o, g, error in document.get("correspondences", [])},
        )

    @one_thread_per_kernel()
    def _compute(self, answers: Sequence[Answer]) -> None:
        start = time.perf_counter()
        with self.context.progress.bar(len(self.scorer.images), "scores", "image") as advance:
            scored = self.scorer.score([row for _, row in _result_rows(answers)], progress=advance)
        by_answer = _group_by_answer(answers, scored.errors)
        document: dict[str, Any] = {
            "errors": [errors_to_record(errors) for errors in scored.errors],
            "scores": scores_to_record(scored.scores),
            "templates": self._template_errors(answers, by_answer),
        }
        if self.replayer:
            document["correspondences"] = self._correspondence_errors(self.replayer, answers, by_answer)
        seconds = time.perf_counter() - start
        self.context.store.put_document(self.ref, document, rows=len(answers), time_s=seconds)
        self.context.timings.add(self._timing_key, len(self.context.targets), seconds)

    def _template_errors(
        self, answers: Sequence[Answer], by_answer: Sequence[PoseErrors | None]
    ) -> list[list[int | float]]:
        """Angles between the matched template and the true view, by instance."""
        error_of_instance: dict[Instance, TemplateError] = {}
        for answer, errors in zip(answers, by_answer, strict=True):
            instance = _instance(answer, errors)
            if instance is None or answer.template_id is None:
                continue
            _, _, obj_id, _ = instance
            T_template = self.templates.read_views(obj_id, [answer.template_id]).T_cam_obj[0]
            symmetries = self.scorer.mesh(obj_id).model.symmetries
            error_of_instance[instance] = template_error(T_template, self._true_pose(instance), symmetries)
        return [[*instance, *asdict(error).values()] for instance, error in error_of_instance.items()]

    def _correspondence_errors(
        self, replayer: Replayer, answers: Sequence[Answer], by_answer: Sequence[PoseErrors | None]
    ) -> list[list[int | float]]:
        """Median error of the answer's correspondences over the diameter, by instance."""
        rows: list[list[int | float]] = []
        by_object = sorted(zip(answers, by_answer, strict=True), key=lambda pair: pair[0].obj_id)
        with self.context.progress.bar(len(answers), "correspondences", "answer") as advance:
            for answer, errors in by_object:  # in this order, each object's templates are read once
                advance(1)
                instance = _instance(answer, errors)
                traced = replayer(answer) if instance else None
                if instance and traced and traced.hypothesis:
                    error = self._median_correspondence_error(instance, traced.hypothesis)
                    rows += [] if error is None else [[*instance, error]]
        return rows

    def _median_correspondence_error(self, instance: Instance, hypothesis: Hypothesis) -> float | None:
        """Median error over the diameter; None without correspondences."""
        if hypothesis.points_obj is None or hypothesis.query_px_img is None:
            return None
        scene_id, im_id, obj_id, _ = instance
        model, K = self.scorer.mesh(obj_id).model, self.context.K((scene_id, im_id))
        errors_mm = correspondence_errors_mm(
            hypothesis.points_obj, hypothesis.query_px_img, K, self._true_pose(instance), model.symmetries
        )
        return float(np.median(errors_mm)) / model.diameter_mm if len(errors_mm) else None

    def _true_pose(self, instance: Instance) -> Float[np.ndarray, "4 4"]:
        scene_id, im_id, _, gt_id = instance
        return self.context.dataset.ground_truth(scene_id, im_id)[gt_id].T_cam_obj


def _result_rows(answers: Sequence[Answer]) -> list[tuple[int, ResultRow]]:
    """The estimates among the answers as result rows, each with the index of its answer."""
    return [
        (index, ResultRow(a.scene_id, a.im_id, a.obj_id, a.score, a.T_cam_obj, -1.0))
        for index, a in enumerate(answers)
        if isinstance(a, PoseEstimate)
    ]


def _group_by_answer(answers: Sequence[Answer], errors: Sequence[PoseErrors]) -> tuple[PoseErrors | None, ...]:
    """Errors of each answer against its detection's instance, or else the one with the lowest MSSD."""
    by_row: defaultdict[int, list[PoseErrors]] = defaultdict(list)
    for error in errors:
        by_row[error.row].append(error)
    by_answer: list[PoseErrors | None] = [None] * len(answers)
    for row, (index, _) in enumerate(_result_rows(answers)):
        same_instance = [e for e in by_row[row] if e.gt_id == answers[index].gt_id] or by_row[row]
        by_answer[index] = min(same_instance, key=lambda e: e.mssd_mm, default=None)
    return tuple(by_answer)


def _instance(answer: Answer, errors: PoseErrors | None) -> Instance | None:
    """The annotated instance of an answer: its detection's, or else that of its errors; None without either."""
    gt_id = errors.gt_id if answer.gt_id is None and errors is not None else answer.gt_id
    return None if gt_id is None else (answer.scene_id, answer.im_id, answer.obj_id, gt_id)
