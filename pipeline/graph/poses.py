"""template features, query features, stages -> poses, one entry per scene and object, and the entry of the run."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.bop.masks import pixels_of
from pipeline.bop.symmetries import SYMMETRIES_VERSION
from pipeline.confidence.evidence import collect_evidence
from pipeline.errors import NoPose
from pipeline.functional.depth_fit import fit_depth
from pipeline.functional.symmetry import make_canonical
from pipeline.graph.bank import StoredBank
from pipeline.graph.context import Context, ImageId
from pipeline.graph.priors import Priors
from pipeline.graph.queries import CroppedDetection, QueryNodes
from pipeline.graph.tasks import Advance, Task
from pipeline.graph.templates import TemplateNodes
from pipeline.graph.timings import timing_key
from pipeline.hypotheses import template_pose
from pipeline.items.online import Prior, Query, Trace, Truth
from pipeline.items.poses import Alternative, NoEstimate, PoseEstimate
from pipeline.items.records import Answer, answer_from_record, answer_to_record
from pipeline.items.views import Detection, Target
from pipeline.method import ONLINE_STAGES
from pipeline.route import Route
from pipeline.spec import digest
from pipeline.stages.render.raycast import render_depth
from pipeline.store import Ref, make_ref
from pipeline.tracking import trace_detection

POSES_VERSION = 4
KEPT = 8  # detections whose best hypothesis stays in memory, for the picture of how its pose was found


@dataclass(eq=False)
class PoseNodes:
    """Nodes of poses. Methods named by a noun return references to entries; ``estimate`` computes missing entries."""

    context: Context
    templates: TemplateNodes
    queries: QueryNodes
    _kept: dict[int, Trace] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def priors(self) -> Priors:
        """Expected poses."""
        return Priors(self.context, self.templates.extents)

    @cached_property
    def groups(self) -> dict[tuple[int, int], list[Target]]:
        """Targets by (scene_id, obj_id). The poses of each group are one entry."""
        grouped: dict[tuple[int, int], list[Target]] = {}
        for target in self.context.targets:
            grouped.setdefault((target.scene_id, target.obj_id), []).append(target)
        return dict(sorted(grouped.items()))

    @cached_property
    def poses(self) -> Callable[[tuple[int, int]], Ref]:
        """Poses of one object in one scene."""
        return lru_cache(maxsize=None)(self._poses)

    def _poses(self, group: tuple[int, int]) -> Ref:
        stages, (_, obj_id) = self.context.stages, group
        recipe = {"kind": "poses", "version": POSES_VERSION, "fallback": stages.fallback}
        recipe |= {name: getattr(stages, name).recipe() for name in ONLINE_STAGES}
        if stages.second_look.hypotheses:  # renderer and extractor are in the keys of the templates and their features
            recipe["second look"] = stages.second_look.recipe()
        if self._uses_depth:
            recipe["depth"] = stages.depth.recipe()
        if stages.segments:
            recipe["segment"] = stages.segment.recipe()
        recipe |= self.priors.recipe(self.groups[group])
        inputs = {"templates": self.templates.templates(obj_id).key, "template crops": self.templates.crops(obj_id).key}
        for layer in stages.layers:
            inputs[f"template layer {layer}"] = self.templates.features(obj_id, layer).key
        for n, fit in enumerate(stages.fits):
            inputs[f"fit {n}"] = self.templates.fitted(obj_id, fit).key
        if (encodings := self.templates.encodings(obj_id)) is not None:
            inputs["template encodings"] = encodings.key
        if (info := self.context.dataset.models_info.get(obj_id)) is not None:  # else measured on the mesh
            inputs["object"] = digest([info.diameter_mm, info.symmetries.tolist()])
        elif self.context.dataset.finds_symmetries:
            inputs["object"] = digest(["found", SYMMETRIES_VERSION])
        for target in self.groups[group]:
            image = (target.scene_id, target.im_id)
            asked = [target.inst_count, self.context.K(image).tolist()]
            asked += [self.queries.detecting.identity(d) for _, d in self._detections(target)]
            if stages.oracle:
                asked += [self._truth(d).T_cam_obj.tolist() for _, d in self._detections(target)]
                asked += [self.context.model(obj_id).symmetries.tolist()]
            if self._uses_depth:
                asked.append(self.context.dataset.depth_identity(*image))
            features = [self.queries.features(image, layer).key for layer in stages.layers]
            inputs[f"image {target.im_id}"] = digest([asked, self.queries.crops(image).key, features])
        return make_ref("poses", recipe, inputs)

    def run_ref(self) -> Ref:
        """The run's entry: the poses of all targets, with their confidence."""
        calibration = self.context.calibration
        recipe = {"kind": "run"} | ({} if calibration is None else {"calibration": calibration.digest})
        return make_ref("runs", recipe, {f"{s}/{o}": self.poses((s, o)).key for s, o in self.groups})

    def estimate(self) -> list[Answer]:
        """One answer per detection of each target, and one per target without a detection."""
        ref = self.run_ref()
        if not self.context.store.is_complete(ref):
            self._make(ref)
        answers = [answer_from_record(record) for record in self.context.store.read(ref).document["answers"]]
        self._count_reused(len(answers))
        return answers

    def _make(self, ref: Ref) -> None:
        missing = [group for group in self.groups if not self.context.store.is_complete(self.poses(group))]
        self._make_queries(sorted({(t.scene_id, t.im_id) for group in missing for t in self.groups[group]}))
        total = sum(len(self.groups[group]) for group in missing)
        with self.context.progress.bar(total, "poses", "target") as advance:
            self.context.run_task(self.solve_task, sorted(missing, key=lambda group: group[1]), advance)
        made = [self.context.store.read(self.poses(group)).document["answers"] for group in self.groups]
        records = [self._calibrate(record) for answers in made for record in answers]
        self.context.store.put_document(ref, {"answers": records}, rows=len(records))

    def _calibrate(self, record: dict[str, Any]) -> dict[str, Any]:
        """The record of an answer with its confidence, where a calibration fits the method."""
        answer = answer_from_record(record)
        if self.context.calibration is None or isinstance(answer, NoEstimate):
            return record
        return answer_to_record(self.context.calibration.apply(answer))

    def _make_queries(self, images: Sequence[ImageId]) -> None:
        with self.context.progress.bar(len(images), "query features", "image") as advance:
            self.context.run_task(self.queries.describe_task, images, advance)

    def _count_reused(self, answers: int) -> None:
        """Count entries that this run needed but did not compute as reused."""
        usable = sum(len(found) for found in self.queries.of_image.values())
        for step, rows in (("query crops", usable), ("query features", usable), ("poses", answers)):
            count = self.context.progress.step(step)
            self.context.progress.add(step, reused=max(0, rows - count.computed - count.reused))

    @cached_property
    def solve_task(self) -> Task[tuple[int, int]]:
        """Poses, by scene and object."""
        done, size = self.context.store.is_complete, self.groups
        return Task("poses", self._solve, lambda group: done(self.poses(group)), lambda group: len(size[group]))

    def _solve(self, group: tuple[int, int], advance: Advance) -> None:
        ref, (_, obj_id) = self.poses(group), group
        bank, began = self.templates.bank(obj_id), time.perf_counter()
        answers, before = list[Answer](), list[Answer]()
        for target in self.groups[group]:
            before = self._answers(target, bank, before)
            answers += before
            advance(1)
        seconds = sum(sum(a.times_s.values()) for a in answers if isinstance(a, PoseEstimate))
        document = {"answers": [answer_to_record(answer) for answer in answers]}
        self.context.store.put_document(ref, document, rows=len(answers), time_s=seconds)
        self.context.progress.add("poses", computed=len(answers), time_s=seconds)
        templates = self.templates.context.store.read(self.templates.templates(obj_id)).rows
        work = timing_key("poses", self.context.stages, rows=templates)
        self.context.timings.add(work, len(self.groups[group]), time.perf_counter() - began)

    def _detections(self, target: Target) -> list[tuple[int, Detection]]:
        return self.queries.of_target.get((target.scene_id, target.im_id, target.obj_id), [])

    def _answers(self, target: Target, bank: StoredBank, before: Sequence[Answer]) -> list[Answer]:
        """One answer per detection of a target, or one that says that there is no detection.

        ``before``: the answers of the object's target before this one.
        """
        cropped = {found.index: found for found in self.queries.found((target.scene_id, target.im_id))}
        mine = self._detections(target)
        if not mine:
            reason = f"object {target.obj_id} was not detected in scene {target.scene_id}, image {target.im_id}"
            return [NoEstimate(target.scene_id, target.im_id, target.obj_id, "detect", reason)]
        return [self._answer(nth, index, d, cropped.get(index), bank, before) for nth, (index, d) in enumerate(mine)]

    def _answer(
        self,
        nth: int,
        index: int,
        d: Detection,
        found: CroppedDetection | None,
        bank: StoredBank,
        before: Sequence[Answer],
    ) -> Answer:
        template_id: int | None = None
        try:
            if d.defect is not None:
                raise NoPose("detect", d.defect)
            if found is None:
                raise NoPose("crop", self.queries.crop_failure(index, d))
            query, shared_s = self.query(found, self.priors.prior(d, nth, before))
            trace = trace_detection(self.context.stages, query, bank)
            self._keep(index, trace)
            template_id = trace.best.template_id
            used = query if trace.query is None else replace(trace.query, prior=query.prior)
            return self._estimate(nth, d, used, trace, bank, shared_s)
        except NoPose as failure:
            return NoEstimate(d.scene_id, d.im_id, d.obj_id, failure.stage, failure.reason, nth, d.gt_id, template_id)

    def _keep(self, index: int, trace: Trace) -> None:
        self._kept[index] = replace(trace, hypotheses=trace.hypotheses[:1])
        while len(self._kept) > KEPT:
            del self._kept[next(iter(self._kept))]

    def retrace(self, found: CroppedDetection, bank: StoredBank) -> Trace:
        """How the pose of a detection was found: from memory for the last few, otherwise computed once more.

        From memory, there is no other hypothesis than the best.
        """
        if (kept := self._kept.get(found.index)) is not None:
            return kept
        target = next(t for t in self.context.targets if _is_of(found.detection, t))
        nth = [index for index, _ in self._detections(target)].index(found.index)
        prior = self.priors.prior(found.detection, nth, self._answers_before(target))
        return trace_detection(self.context.stages, self.query(found, prior)[0], bank)

    def _answers_before(self, target: Target) -> list[Answer]:
        """The stored answers of the frame before a target's, of the same object; none of a data set without order."""
        if not self.context.dataset.is_video:
            return []
        group = (target.scene_id, target.obj_id)
        earlier = [t for t in self.groups[group] if t.im_id < target.im_id]
        stored = map(answer_from_record, self.context.store.read(self.poses(group)).document["answers"])
        return [answer for answer in stored if earlier and answer.im_id == earlier[-1].im_id]

    def query(self, found: CroppedDetection, prior: Prior | None = None) -> tuple[Query, dict[str, float]]:
        """A detection as input of the online route (with ground truth for oracles only), and its seconds."""
        query, shared_s = self.queries.query(found)
        query = replace(query, prior=prior)
        if self.context.stages.oracle:
            query = replace(query, truth=self._truth(found.detection))
        return query, shared_s

    def _truth(self, d: Detection) -> Truth:
        T_cam_obj = self.queries.true_pose(d, asked_by=self.context.stages.oracle)
        return Truth(T_cam_obj, self.context.model(d.obj_id).symmetries)

    def _estimate(
        self, nth: int, d: Detection, query: Query, trace: Trace, bank: StoredBank, shared_s: Mapping[str, float]
    ) -> PoseEstimate:
        best, matches = trace.best, trace.best.matches
        if best.solution is not None:
            T_cam_obj, fallback = best.solution.T_cam_obj, ""
        elif self.context.stages.fallback:
            T_cam_obj = template_pose(query, bank.view(best.template_id))
            fallback = f"rotation of template {best.template_id}, scale of the crop ({best.failure})"
        else:
            raise best.failure or NoPose("solve", "no hypothesis")
        count = 0 if matches is None else len(matches.similarity)
        notes = best.notes
        if self._uses_depth:
            T_cam_obj, note = self._fit_depth(T_cam_obj, d)
            notes = (*notes, note)
        evidence, alternatives = self._evidence(trace, query, bank, d.obj_id)
        return PoseEstimate(
            scene_id=d.scene_id,
            im_id=d.im_id,
            obj_id=d.obj_id,
            detection_id=nth,
            T_cam_obj=self._canonical(T_cam_obj, d.obj_id, query.prior),
            score=d.score * best.inliers / max(count, 1),
            detection_score=d.score,
            template_id=best.template_id,
            template_score=best.template_score,
            template_margin=trace.match.margin,
            correspondences=count,
            inliers=best.inliers,
            reprojection_px=best.solution.reprojection_px if best.solution else None,
            gt_id=d.gt_id,
            fallback=fallback,
            notes=notes,
            times_s={**shared_s, **trace.times_s},
            evidence=evidence,
            alternatives=tuple(replace(a, T_cam_obj=self._canonical(a.T_cam_obj, d.obj_id)) for a in alternatives),
        )

    @property
    def _uses_depth(self) -> bool:
        """Whether poses are fitted to measured depth."""
        use = self.context.stages.depth.use
        return use == "always" or (use == "given" and self.context.dataset.gives_depth)

    def _fit_depth(self, T_cam_obj: Float[np.ndarray, "4 4"], d: Detection) -> tuple[Float[np.ndarray, "4 4"], str]:
        """The pose fitted to the depth image inside the detection, and a note that says so."""
        context, image = self.context, (d.scene_id, d.im_id)
        depth_mm, K, model = context.dataset.depth_mm(*image), context.K(image), context.model(d.obj_id)
        mask = pixels_of(d.rle, d.bbox_xyxy, (depth_mm.shape[0], depth_mm.shape[1]))

        def render(T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "H W"]:
            return render_depth(model.mesh, K, T[None], depth_mm.shape)[0]

        rounds = context.stages.depth.rounds
        fitted = fit_depth(T_cam_obj, render, depth_mm, mask, K, model.diameter_mm, rounds=rounds)
        moved_mm = float(np.linalg.norm(fitted[:3, 3] - T_cam_obj[:3, 3]))
        return fitted, f"RGB-D: fitted to the depth image, translation moved by {moved_mm:.1f} mm"

    def _evidence(
        self, trace: Trace, query: Query, bank: StoredBank, obj_id: int
    ) -> tuple[dict[str, float], tuple[Alternative, ...]]:
        """Evidence of a solved pose and its alternatives; nothing for a fallback."""
        if trace.best.solution is None or trace.best.pair is None:
            return {}, ()
        route = Route(self.context.stages, query, bank)
        geometry = route.geometry(route.view(trace.best), trace.best.pair)
        return collect_evidence(trace, query, geometry, self.templates.extents.read(obj_id))

    def _canonical(
        self, T_cam_obj: Float[np.ndarray, "4 4"], obj_id: int, prior: Prior | None = None
    ) -> Float[np.ndarray, "4 4"]:
        """The pose, or, where symmetries were found, the copy nearest the prior or the one that stands for all."""
        if not self.context.dataset.finds_symmetries:
            return T_cam_obj
        near = np.eye(4) if prior is None else prior.T_cam_obj
        return make_canonical(T_cam_obj, self.templates.extents.read(obj_id).symmetries, near=near)


def _is_of(d: Detection, target: Target) -> bool:
    return (d.scene_id, d.im_id, d.obj_id) == (target.scene_id, target.im_id, target.obj_id)
