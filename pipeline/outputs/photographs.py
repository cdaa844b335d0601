"""Answers of a run on the user's photographs -> one folder per photograph, and lines for the terminal."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

from pipeline.graph.context import ImageId
from pipeline.items.poses import PoseEstimate
from pipeline.items.records import Answer
from pipeline.outputs.folder import OutputFolder
from pipeline.outputs.photo_files import LATEST, Cards, holds_results, link_latest, save_results
from pipeline.outputs.pictures import Pictures
from pipeline.outputs.pose_result import PoseResult, confidence_warnings, result_of
from pipeline.spec import digest

FILES_VERSION = 3
"""Raise it when the files written for the same results change."""
RESERVED = (LATEST, "report", "multirun", "records")  # names of other files and folders in the folder of results


@dataclass(eq=False)
class Photographs:
    """The results of a run, by photograph."""

    folder: OutputFolder
    pictures: Pictures
    answers: Sequence[Answer]
    warnings: Sequence[str]

    @cached_property
    def results(self) -> list[PoseResult]:
        """The result of each answer."""
        context, data = self.folder.context, self.folder.context.dataset
        images = {image: data.image(*image) for image in context.image_ids}
        return [
            result_of(
                answer,
                data.object_name(answer.obj_id),
                mesh=str(data.model_path(answer.obj_id)),
                image=images[answer.scene_id, answer.im_id],
                warnings=self.warnings,
            )
            for answer in self.answers
        ]

    def write(self, *, overlays: bool, cards: bool) -> list[Path]:
        """Write the folder of every photograph unless it already holds these results; returns the folders."""
        by_image: defaultdict[ImageId, list[int]] = defaultdict(list)
        for index, answer in enumerate(self.answers):
            by_image[answer.scene_id, answer.im_id].append(index)
        data, folders = self.folder.context.dataset, []
        for image, indices in by_image.items():
            folder = self.folder.out / self._folder_name(image)
            more = {"run": str(self.folder.path), "made_from": self._made_from(image, indices, cards=cards)}
            if not holds_results(folder, more["made_from"], overlay=overlays):
                save_results(
                    [self._with_model(index) for index in indices],
                    folder,
                    image=str(data.image_path(*image)),
                    more=more,
                    overlay=overlays,
                    cards=partial(self._cards, indices) if cards else None,
                    note=data.image_note,
                )
            folders.append(folder)
        if folders:
            link_latest(folders[-1])
        return folders

    def _made_from(self, image: ImageId, indices: Sequence[int], *, cards: bool) -> str:
        """Digest of what the files of a photograph show: its poses, and what is not in their keys."""
        data = self.folder.context.dataset
        named = [[self.results[index].name, self.results[index].mesh] for index in indices]
        shown = [str(data.image_path(*image)), str(self.folder.path), named, list(self.warnings), cards]
        return digest([FILES_VERSION, self.pictures.made_from, shown])

    def text(self) -> str:
        """One line per result, with the photograph's name if there are several."""
        data, several = self.folder.context.dataset, len(self.folder.context.image_ids) > 1
        lines = []
        for answer, result in zip(self.answers, self.results, strict=True):
            image = f"{data.image_name(answer.scene_id, answer.im_id)}: " if several else ""
            lines.append(f"{image}{result.summary()}")
            if result.found:
                lines.append(f"  {result.inliers} of {result.correspondences} matches agree{result.details()}")
            if isinstance(answer, PoseEstimate):
                lines += [f"warning: {image}{text}" for text in confidence_warnings(answer, result.name)]
        return "\n".join(lines)

    def _with_model(self, index: int) -> PoseResult:
        """A result that can be drawn. Reads the mesh, which a cached run does not need."""
        return replace(self.results[index], model=self.folder.context.model(self.answers[index].obj_id))

    def _folder_name(self, image: ImageId) -> str:
        """The photograph's name without suffix; a number is added if another photograph has the same name."""
        data = self.folder.context.dataset
        names = {other: Path(data.image_name(*other)).stem.lstrip(".") for other in self.folder.context.image_ids}
        name = names[image] or "photograph"
        is_taken = name in RESERVED or list(names.values()).count(name) > 1
        return f"{name}_{image[1]}" if is_taken else name

    def _cards(self, indices: Sequence[int]) -> Cards:
        return [self.pictures.draw_card(index) for index in indices]
