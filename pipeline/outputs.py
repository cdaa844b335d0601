"""answers and scores of a run -> its files: csv, records, overlays, gallery, and the row that reports read."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pipeline.bop.detections import write_detections
from pipeline.bop.results import make_rows, results_name, write_results
from pipeline.graph import Graph, PoseEvaluation, Retraced, ScoreNodes
from pipeline.io.files import write_json
from pipeline.items.poses import NoEstimate, PoseEstimate
from pipeline.items.records import Answer, answer_to_record
from pipeline.items.scores import CORRECT_MSSD, PoseErrors, TemplateError, errors_to_record
from pipeline.metrics.template_error import ACC_DEG
from pipeline.report.gallery import Card, draw_card, pick_cases
from pipeline.report.overlay import DrawnPose, draw_overlay, write_overlay
from pipeline.report.run_records import Case, RunRecord, finished_run_record, run_id, run_record_path, write_run_record
from pipeline.report.scores import summary_of
from pipeline.scoring import dataset_id

KEY_DIGITS = 12
ImageId = tuple[int, int]


@dataclass(eq=False)
class Outputs:
    """Where a run's results lie and how they get there.

    ``scores`` None: nothing is held against ground truth; ``label``: the variant of every stage; ``theta_max``:
    thresholds above it are left out of the averages.
    """

    graph: Graph
    scores: ScoreNodes | None
    out: Path
    name: str
    config: Mapping[str, Any]
    label: Mapping[str, str]
    sweep: str | None
    theta_max: float

    @cached_property
    def csv(self) -> str:
        """Name of the results file."""
        data = self.graph.context.dataset
        return results_name(self.name, data.name, data.split)

    @cached_property
    def folder(self) -> Path:
        """The run's folder: its name is the key of all that lies in it."""
        return self.out / self.csv.removesuffix(".csv") / self.graph.poses.run_ref().key[:KEY_DIGITS]

    @property
    def overlays(self) -> Path:
        """Folder of the overlays: another for poses that are not held against the ground truth there is."""
        annotated = all(self.graph.context.dataset.has_ground_truth(t.scene_id) for t in self.graph.context.targets)
        return self.folder / ("overlays" if self.scores or not annotated else "overlays-unchecked")

    @cached_property
    def run_record_path(self) -> Path:
        """The file of the run's row."""
        return run_record_path(self.out, run_id(self.config))

    def finished(self) -> bool:
        """Whether an earlier run of the same configuration, on the same inputs, has left all its files."""
        row = self._row_before()
        return row is not None and (self.out / row.folder / row.csv).exists()

    def _row_before(self) -> RunRecord | None:
        """The row that an earlier run of the same configuration on the same inputs has left, if it ended well."""
        row = finished_run_record(self.out, run_id(self.config))
        return row if row and self.scores and row.run == self.scores.ref.key else None

    def write_detections(self) -> Path:
        """Detections that can be used, as detect=json reads them; returns their file."""
        path = self.folder / "detections.json"
        write_detections(path, self.graph.detections.all)
        return path

    def write_files(self, answers: Sequence[Answer], judged: PoseEvaluation | None, warnings: Sequence[str]) -> None:
        """The csv, poses.json (``warnings``: odd detections), and detections.json of those not read from a file."""
        if self.graph.detections.proposals:
            self.write_detections()
        estimates = [answer for answer in answers if isinstance(answer, PoseEstimate)]
        write_results(self.folder / self.csv, make_rows(estimates, _seconds_by_image(answers)))
        errors = _errors(answers, judged)
        told = [
            answer_to_record(a) | {"errors": e and errors_to_record(e)} for a, e in zip(answers, errors, strict=True)
        ]
        record = {
            "run": self.graph.poses.run_ref().key,
            "method": self.name,
            "dataset": self.graph.context.dataset.name,
            "config": self.config,
            "counts": self.graph.context.progress.as_record(),
            "scores": judged and summary_of(judged.scored),
            "warnings": list(warnings),
            "answers": told,
        }
        write_json(self.folder / "poses.json", record)

    def places(self, *, overlays: bool) -> str:
        """Lines that say where everything lies."""
        lines = [f"csv       {self.folder / self.csv}", f"records   {self.folder / 'poses.json'}"]
        if self.graph.detections.proposals:
            lines.append(f"detected  {self.folder / 'detections.json'}")
        if overlays:
            right = f"ground truth blue; green: MSSD < {CORRECT_MSSD:.0%} of the diameter"
            lines.append(f"overlays  {self.overlays}  ({right if self.scores else 'estimates'})")
        return "\n" + "\n".join(lines)

    def draw_overlays(self, answers: Sequence[Answer], judged: PoseEvaluation | None) -> None:
        """A picture for every image; those that are there are left, since the folder is the key of what they show."""
        by_image: defaultdict[ImageId, list[tuple[Answer, PoseErrors | None]]] = defaultdict(list)
        for answer, errors in zip(answers, _errors(answers, judged), strict=True):
            by_image[answer.scene_id, answer.im_id].append((answer, errors))
        start, drawn = time.perf_counter(), 0
        with self.graph.context.progress.bar(len(by_image), "overlays", "image") as advance:
            for image, shown in sorted(by_image.items()):
                path = self.overlays / f"{image[0]:06d}_{image[1]:06d}.jpg"
                if not path.exists():
                    write_overlay(path, draw_overlay(self.graph.context.dataset.image(*image), self._drawn(shown)))
                    drawn += 1
                advance(1)
        seconds = time.perf_counter() - start
        self.graph.context.progress.add("overlays", computed=drawn, reused=len(by_image) - drawn, time_s=seconds)

    def draw_gallery(self, answers: Sequence[Answer], judged: PoseEvaluation, count: int) -> list[Case]:
        """Pictures of how the best and the worst answers came about; those that are there are left."""
        if not count:
            return []
        start, drawn, cases = time.perf_counter(), 0, []
        retrace, errors = self.graph.retracer(), _errors(answers, judged)
        relative = [None if e is None else e.relative_mssd for e in errors]
        chosen = pick_cases(relative, count=count, obj_ids=[a.obj_id for a in answers])
        with self.graph.context.progress.bar(len(chosen), "gallery", "picture") as advance:
            for index in sorted(chosen, key=lambda i: answers[i].obj_id):
                answer = answers[index]
                path = self.folder / "gallery" / f"{_named(answer)}.jpg"
                if not path.exists() and (traced := retrace(answer)) is not None:
                    write_overlay(path, draw_card(self._card(answer, errors[index], traced)), quality=82)
                    drawn += 1
                advance(1)
        cases = [self._case(answers[index], errors[index]) for index in chosen]
        seconds = time.perf_counter() - start
        self.graph.context.progress.add("gallery", computed=drawn, reused=len(chosen) - drawn, time_s=seconds)
        return [case for case in cases if (self.folder / case.file).exists()]

    def _card(self, answer: Answer, errors: PoseErrors | None, traced: Retraced) -> Card:
        best = traced.hypothesis
        return Card(
            photo=self.graph.context.dataset.image(answer.scene_id, answer.im_id),
            bbox_xyxy=traced.detection.bbox_xyxy,
            drawn=[replace(item, label="") for item in self._drawn([(answer, errors)], gt_id=answer.gt_id)],
            query_rgb=traced.query_rgb,
            template_rgb=traced.template_rgb,
            clusters=None if best is None else best.clusters,
            matches=None if best is None else best.matches,
            inliers=best.solution.inliers if best and best.solution else None,
            reason=f"{answer.stage}: {answer.reason}" if isinstance(answer, NoEstimate) else "",
        )

    def _case(self, answer: Answer, errors: PoseErrors | None) -> Case:
        text = f"{answer.stage}: {answer.reason}" if isinstance(answer, NoEstimate) else f"score {answer.score:.2f}"
        if errors is not None:
            text += f", {errors.symmetric_rotation_deg:.0f} degrees and {errors.translation_mm:.0f} mm off"
        ids, file = (answer.scene_id, answer.im_id, answer.obj_id), f"gallery/{_named(answer)}.jpg"
        return Case(file, *ids, None if errors is None else errors.relative_mssd, text)

    def _drawn(self, shown: Sequence[tuple[Answer, PoseErrors | None]], *, gt_id: int | None = None) -> list[DrawnPose]:
        """Every estimate of an image and, where they are held against it, the ground truth of its targets.

        ``gt_id``: of this instance alone.
        """
        run, first = self.graph.context, shown[0][0]
        asked = {answer.obj_id for answer, _ in shown} if self.scores else set()
        truths = run.dataset.ground_truth(first.scene_id, first.im_id) if asked else []
        wanted = [gt for gt in truths if gt.obj_id in asked and gt_id in (None, gt.gt_id)]
        drawn = [DrawnPose(run.model(gt.obj_id).mesh, gt.T_cam_obj, "truth") for gt in wanted]
        for answer, errors in shown:
            if isinstance(answer, PoseEstimate):
                label = f"{answer.obj_id}: {answer.score:.2f}"
                drawn.append(DrawnPose(run.model(answer.obj_id).mesh, answer.T_cam_obj, _role(errors), label))
        return drawn

    def write_run_record(self, answers: Sequence[Answer], judged: PoseEvaluation, cases: Sequence[Case]) -> None:
        """The row that reports read."""
        assert self.scores is not None
        run, scores = self.graph.context, judged.scored.scores
        metrics = summary_of(judged.scored, theta_max=self.theta_max)["metrics"]
        missing = Counter((a.stage, a.reason) for a in answers if isinstance(a, NoEstimate))
        row = RunRecord(
            id=run_id(self.config),
            status="done",
            at=now(),
            method=self.name,
            config=self.config,
            label=self.label,
            sweep=self.sweep or "",
            notice=run.stages.extract.notice,
            dataset=dataset_id(self.scores.scorer),
            run=self.scores.ref.key,
            folder=self.folder.relative_to(self.out).as_posix(),
            csv=self.csv,
            estimates=sum(isinstance(answer, PoseEstimate) for answer in answers),
            counts=run.progress.as_record(),
            times_s=_median_times(answers),
            bytes_per_object=self.graph.templates.feature_bytes() / max(len(run.object_ids), 1),
            failures=tuple((stage, reason, count) for (stage, reason), count in missing.most_common()),
            metrics=metrics | _template_metrics(judged, len(scores)),
            scores=scores,
            templates=judged.templates,
            cases=tuple(cases),
        )
        before = self._row_before()
        if before is not None:  # what was computed is what the first run computed
            row = replace(row, at=before.at, counts=before.counts, sweep=before.sweep)
        print(f"row       {write_run_record(self.out, row)}")


def now() -> str:
    """The time, as rows say it."""
    return datetime.now(UTC).isoformat(timespec="microseconds")


def _errors(answers: Sequence[Answer], judged: PoseEvaluation | None) -> Sequence[PoseErrors | None]:
    return [None] * len(answers) if judged is None else judged.by_answer


def _named(answer: Answer) -> str:
    """Name of an answer's picture."""
    return f"{answer.scene_id:06d}_{answer.im_id:06d}_{answer.obj_id:06d}_{answer.detection_id or 0:02d}"


def _role(errors: PoseErrors | None) -> Literal["correct", "wrong", "unchecked"]:
    if errors is None:
        return "unchecked"
    return "correct" if errors.looks_right else "wrong"


def _seconds_by_image(answers: Sequence[Answer]) -> dict[ImageId, float]:
    """BOP's time of an image: all its detections together, features included."""
    seconds: defaultdict[ImageId, float] = defaultdict(float)
    for answer in answers:
        if isinstance(answer, PoseEstimate):
            seconds[answer.scene_id, answer.im_id] += sum(answer.times_s.values())
    return dict(seconds)


def _median_times(answers: Sequence[Answer]) -> dict[str, float]:
    """Median seconds of a pose by stage."""
    times = [answer.times_s for answer in answers if isinstance(answer, PoseEstimate)]
    stages = dict.fromkeys(stage for by_stage in times for stage in by_stage)
    return {stage: float(np.median([by_stage.get(stage, 0.0) for by_stage in times])) for stage in stages}


def _template_metrics(judged: PoseEvaluation, instances: int) -> dict[str, float | None]:
    """Acc15 in its three readings, over all instances, and the mean angle, over those with a matched template."""
    told: dict[str, float | None] = {}
    for reading in (f.name for f in fields(TemplateError)):
        angles = np.array([getattr(error, reading) for error in judged.templates.values()])
        told[f"Acc{ACC_DEG:.0f}_{reading}"] = float((angles < ACC_DEG).sum() / max(instances, 1))
        told[f"template_error_{reading}_deg"] = float(angles.mean()) if len(angles) else None
    if judged.correspondences:
        told["correspondence_error_percent"] = 100 * float(np.median(list(judged.correspondences.values())))
    return told
