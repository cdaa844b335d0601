"""Answers, evaluation -> csv, poses.json and detections.json."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from pipeline.bop.detections import write_detections
from pipeline.bop.results import make_rows, write_results
from pipeline.graph import PoseEvaluation
from pipeline.graph.context import ImageId
from pipeline.io.files import write_json
from pipeline.items.errors import CORRECT_MSSD, PoseErrors
from pipeline.items.poses import PoseEstimate
from pipeline.items.records import Answer, answer_to_record, errors_to_record
from pipeline.outputs.folder import OutputFolder
from pipeline.report.scores import summary_of


def write_computed_detections(folder: OutputFolder) -> Path:
    """Write the usable detections in the format that detect=json reads; returns the file."""
    write_detections(folder.detections, folder.graph.detections.all)
    return folder.detections


def write_files(
    folder: OutputFolder, answers: Sequence[Answer], evaluation: PoseEvaluation | None, warnings: Sequence[str]
) -> None:
    """Write the csv, poses.json and, unless they were read from a file, the detections."""
    if folder.graph.detections.computed:
        write_computed_detections(folder)
    estimates = [answer for answer in answers if isinstance(answer, PoseEstimate)]
    write_results(folder.path / folder.csv_name, make_rows(estimates, _seconds_by_image(estimates)))
    record = {
        "run": folder.graph.poses.run_ref().key,
        "method": folder.options.name,
        "dataset": folder.context.dataset.name,
        "detections": folder.context.stages.detect.summary,
        "config": folder.options.config,
        "counts": folder.context.progress.as_record(),
        "scores": evaluation and summary_of(evaluation.scored),
        "warnings": list(warnings),
        "answers": [
            answer_to_record(answer) | {"errors": errors and errors_to_record(errors)}
            for answer, errors in zip(answers, errors_by_answer(answers, evaluation), strict=True)
        ],
    }
    write_json(folder.path / "poses.json", record)


def places_text(folder: OutputFolder, photographs: Sequence[Path] = (), *, overlays: bool) -> str:
    """Lines for the terminal that name every file and folder that was written, those of photographs first."""
    lines = []
    for photograph in photographs:
        lines.append(f"pose      {photograph / 'pose.json'}")
        if overlays:
            lines += [f"overlay   {photograph / 'overlay.jpg'}", f"page      {photograph / 'pose.html'}"]
    lines += [f"csv       {folder.path / folder.csv_name}", f"poses     {folder.path / 'poses.json'}"]
    if folder.graph.detections.computed:
        lines.append(f"detected  {folder.detections}")
    if overlays:
        colours = f"ground truth blue; green: MSSD < {CORRECT_MSSD:.0%} of the diameter"
        lines.append(f"overlays  {folder.overlays}  ({colours if folder.scores else 'estimates'})")
    return "\n" + "\n".join(lines)


def errors_by_answer(answers: Sequence[Answer], evaluation: PoseEvaluation | None) -> Sequence[PoseErrors | None]:
    """Errors of each answer; None for all of them if the run is not scored."""
    return [None] * len(answers) if evaluation is None else evaluation.by_answer


def _seconds_by_image(estimates: Sequence[PoseEstimate]) -> dict[ImageId, float]:
    """BOP's time of an image: all stages of all its detections."""
    seconds: defaultdict[ImageId, float] = defaultdict(float)
    for estimate in estimates:
        seconds[estimate.scene_id, estimate.im_id] += sum(estimate.times_s.values())
    return dict(seconds)
