"""Answers, evaluation -> pictures: an overlay for every image, and a gallery of how poses came about.

Every picture holds the digest of what it shows: poses, ground truth and scores. It is drawn again when that changes.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

from pipeline.graph import PoseEvaluation, Replay
from pipeline.graph.context import ImageId
from pipeline.items.errors import PoseErrors
from pipeline.items.poses import NoEstimate, PoseEstimate
from pipeline.items.records import Answer
from pipeline.outputs.files import errors_by_answer
from pipeline.outputs.folder import OutputFolder
from pipeline.report.gallery import Card, draw_card, pick_cases
from pipeline.report.overlay import DrawnPose, draw_overlay, shows, write_overlay
from pipeline.report.panels import Picture
from pipeline.report.run_records import Case
from pipeline.spec import digest

GALLERY_JPEG_QUALITY = 82
PICTURES_VERSION = 1
"""Raise it when pictures of the same results look different."""


@dataclass(eq=False)
class Pictures:
    """Draws the answers of one run. ``evaluation`` is None for a run that is not scored."""

    folder: OutputFolder
    answers: Sequence[Answer]
    evaluation: PoseEvaluation | None

    @cached_property
    def made_from(self) -> str:
        """Digest of everything that the pictures show. Images, meshes and cameras are in the key of the poses."""
        scores = None if self.folder.scores is None else self.folder.scores.ref.key
        return digest([PICTURES_VERSION, self.folder.graph.poses.run_ref().key, scores])

    @cached_property
    def errors(self) -> Sequence[PoseErrors | None]:
        """Errors of each answer."""
        return errors_by_answer(self.answers, self.evaluation)

    def draw_overlays(self) -> None:
        """Draw one overlay per image."""
        by_image: defaultdict[ImageId, list[int]] = defaultdict(list)
        for index, answer in enumerate(self.answers):
            by_image[answer.scene_id, answer.im_id].append(index)
        context, start, drawn = self.folder.context, time.perf_counter(), 0
        with context.progress.bar(len(by_image), "overlays", "image") as advance:
            for image, indices in sorted(by_image.items()):
                path = self.folder.overlays / f"{image[0]:06d}_{image[1]:06d}.jpg"
                if not shows(path, self.made_from):
                    photo, note = context.dataset.image(*image), context.dataset.image_note
                    picture = draw_overlay(photo, self._poses_to_draw(indices), note=note)
                    write_overlay(path, picture, made_from=self.made_from)
                    drawn += 1
                advance(1)
        self._count("overlays", drawn, len(by_image), start)

    def draw_gallery(self, count: int) -> list[Case]:
        """Draw how ``count`` of the best and the worst answers came about; returns the pictures that exist."""
        if not count:
            return []
        start, drawn = time.perf_counter(), 0
        replay = self.folder.graph.replayer()
        relative_mssd = [None if errors is None else errors.relative_mssd for errors in self.errors]
        chosen = pick_cases(relative_mssd, count=count, obj_ids=[answer.obj_id for answer in self.answers])
        with self.folder.context.progress.bar(len(chosen), "gallery", "picture") as advance:
            for index in sorted(chosen, key=lambda i: self.answers[i].obj_id):  # reads each object's templates once
                path = self.folder.path / _gallery_file(self.answers[index])
                if not shows(path, self.made_from) and (replayed := replay(self.answers[index])) is not None:
                    picture = draw_card(self._card(index, replayed))
                    write_overlay(path, picture, quality=GALLERY_JPEG_QUALITY, made_from=self.made_from)
                    drawn += 1
                advance(1)
        self._count("gallery", drawn, len(chosen), start)
        cases = [self._case(index) for index in chosen]
        return [case for case in cases if shows(self.folder.path / case.file, self.made_from)]

    def draw_card(self, index: int) -> Picture | None:
        """How an answer came about; None where there is nothing to show."""
        replayed = self.folder.graph.replayer()(self.answers[index])
        return None if replayed is None else draw_card(self._card(index, replayed))

    def _count(self, step: str, drawn: int, total: int, start: float) -> None:
        seconds = time.perf_counter() - start
        self.folder.context.progress.add(step, computed=drawn, reused=total - drawn, time_s=seconds)

    def _card(self, index: int, replayed: Replay) -> Card:
        answer, best = self.answers[index], replayed.hypothesis
        return Card(
            photo=self.folder.context.dataset.image(answer.scene_id, answer.im_id),
            bbox_xyxy=replayed.detection.bbox_xyxy,
            drawn=[replace(pose, label="") for pose in self._poses_to_draw([index], gt_id=answer.gt_id)],
            query_rgb=replayed.query_rgb,
            template_rgb=replayed.template_rgb,
            clusters=None if best is None else best.clusters,
            matches=None if best is None else best.matches,
            inliers=best.solution.inliers if best and best.solution else None,
            reason=_failure_text(answer) if isinstance(answer, NoEstimate) else "",
        )

    def _case(self, index: int) -> Case:
        answer, errors = self.answers[index], self.errors[index]
        text = _failure_text(answer) if isinstance(answer, NoEstimate) else f"score {answer.score:.2f}"
        if errors is not None:
            text += f", {errors.symmetric_rotation_deg:.0f} degrees and {errors.translation_mm:.0f} mm off"
        relative_mssd = None if errors is None else errors.relative_mssd
        return Case(_gallery_file(answer).as_posix(), answer.scene_id, answer.im_id, answer.obj_id, relative_mssd, text)

    def _poses_to_draw(self, indices: Sequence[int], *, gt_id: int | None = None) -> list[DrawnPose]:
        """Estimates among some answers of one image and, if the run is scored, the ground truth of their objects.

        ``gt_id`` restricts the ground truth to one instance.
        """
        context, shown = self.folder.context, [self.answers[index] for index in indices]
        poses = []
        if self.folder.scores:
            obj_ids = {answer.obj_id for answer in shown}
            for gt in context.dataset.ground_truth(shown[0].scene_id, shown[0].im_id):
                if gt.obj_id in obj_ids and gt_id in (None, gt.gt_id):
                    poses.append(DrawnPose(context.model(gt.obj_id).mesh, gt.T_cam_obj, "truth"))
        for index, answer in zip(indices, shown, strict=True):
            if isinstance(answer, PoseEstimate):
                mesh, label = context.model(answer.obj_id).mesh, f"{answer.obj_id}: {answer.score:.2f}"
                poses.append(DrawnPose(mesh, answer.T_cam_obj, _role(self.errors[index]), label))
        return poses


def _gallery_file(answer: Answer) -> Path:
    """File of an answer's picture, relative to the run's folder."""
    name = f"{answer.scene_id:06d}_{answer.im_id:06d}_{answer.obj_id:06d}_{answer.detection_id or 0:02d}"
    return Path("gallery") / f"{name}.jpg"


def _failure_text(answer: NoEstimate) -> str:
    return f"{answer.stage}: {answer.reason}"


def _role(errors: PoseErrors | None) -> Literal["correct", "wrong", "unchecked"]:
    if errors is None:
        return "unchecked"
    return "correct" if errors.looks_right else "wrong"
