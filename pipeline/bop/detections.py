"""Detections <-> a JSON file in the format of BOP's default detections, which ``detect=json`` reads."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from pipeline.bop.jsonio import describe_place, get_field, get_integer, read_json
from pipeline.bop.masks import to_uncompressed
from pipeline.errors import BadInput
from pipeline.io.files import write_json
from pipeline.items.views import Detection, Target

_DIGITS = re.compile(r"[0-9]{1,18}")
_NEEDED = "a list of detections, or a COCO annotation file (images, annotations)"


@dataclass(frozen=True)
class Entry:
    """An entry of a detections file. ``index``: its position there. ``record``: its fields, with a score."""

    index: int
    scene_id: int
    im_id: int
    obj_id: int
    record: dict[str, Any]

    @property
    def target(self) -> tuple[int, int, int]:
        """(scene_id, im_id, obj_id)."""
        return self.scene_id, self.im_id, self.obj_id


def read_entries(path: Path, targets: Sequence[Target]) -> tuple[list[Entry], list[str]]:
    """Entries of a detections file in file order, and warnings. Boxes and masks are not validated yet.

    Also reads COCO annotation files; images are identified by the number in their file name, else by their id. Ids may
    be strings ("000003"). If no entry has a score, all get 1. ``targets``: if they lie in a single scene, COCO
    annotations that name no scene belong to it. Raises BadInput for any other format.
    """
    content = read_json(path)
    if isinstance(content, dict) and isinstance(content.get("images"), list):
        content = _list_annotations(path, content, {target.scene_id for target in targets})
    if not isinstance(content, list):
        found = f"a JSON {type(content).__name__}"
        if isinstance(content, dict):
            found = f"a JSON object with the fields {', '.join(name[:20] for name in list(content)[:8])}"
        raise BadInput(path, found=found, needed=_NEEDED)
    records = [record for record in content if isinstance(record, dict)]
    no_scores = bool(records) and not any("score" in record for record in records)
    entries = [_parse_entry(path, index, record, no_scores=no_scores) for index, record in enumerate(content)]
    warning = (
        f"{path.name}: no entry has a score; all are taken as 1, and entries of one target rank in the file's order"
    )
    return entries, [warning] if no_scores else []


def _parse_entry(path: Path, index: int, record: Any, *, no_scores: bool) -> Entry:
    where = describe_place(path, detection=index)
    scene_id, im_id, obj_id = (_get_id(record, name, where) for name in ("scene_id", "image_id", "category_id"))
    if "segmentation" not in record:
        get_field(record, "bbox", where)
    if no_scores:
        record = record | {"score": 1.0}
    get_field(record, "score", where)
    return Entry(index, scene_id, im_id, obj_id, record)


def _get_id(record: Any, field: str, where: str) -> int:
    """An integer, or a string that spells one."""
    value = get_field(record, field, where)
    if isinstance(value, str) and _DIGITS.fullmatch(value):
        return int(value)
    return get_integer(record, field, where)


def _list_annotations(path: Path, content: dict[str, Any], scene_ids: set[int]) -> list[dict[str, Any]]:
    """Annotations of a COCO file as detections; scene and image are taken from the file name of their image."""
    annotations = get_field(content, "annotations", str(path))
    if not isinstance(annotations, list):
        raise BadInput(f"{path}, field annotations", found=type(annotations).__name__, needed="a list")
    images: dict[int, dict[str, Any]] = {}
    for index, image in enumerate(content["images"]):
        images[_get_id(image, "id", describe_place(path, image=index))] = image
    detections = []
    for index, annotation in enumerate(annotations):
        where = describe_place(path, annotation=index)
        im_id = _get_id(annotation, "image_id", where)
        scene_id, number = _parse_file_name(images.get(im_id, {}).get("file_name"))
        if scene_id is None:
            scene_id = _find_scene(path, where, annotation, scene_ids)
        detections.append(annotation | {"scene_id": scene_id, "image_id": im_id if number is None else number})
    return detections


def _parse_file_name(file_name: Any) -> tuple[int | None, int | None]:
    """Scene and image of "000002/rgb/000003.png"; None for either that the name lacks."""
    path = PurePosixPath(file_name if isinstance(file_name, str) else "")
    scenes = [part for part in path.parts[:-1] if len(part) == 6 and _DIGITS.fullmatch(part)]
    return int(scenes[-1]) if scenes else None, int(path.stem) if _DIGITS.fullmatch(path.stem) else None


def _find_scene(path: Path, where: str, annotation: dict[str, Any], scene_ids: set[int]) -> int:
    """The scene of an annotation: its own field, the folder of its image, or the only scene of the targets."""
    if "scene_id" in annotation:
        return _get_id(annotation, "scene_id", where)
    folder = path.absolute().parent.name
    if len(folder) == 6 and _DIGITS.fullmatch(folder):
        return int(folder)
    if len(scene_ids) == 1:
        return next(iter(scene_ids))
    found = "a COCO annotation file that does not say which scene its images belong to"
    raise BadInput(where, found=found, needed="scene_id, file names such as 000002/rgb/000003.png, or one scene alone")


def write_detections(path: Path, detections: Sequence[Detection]) -> None:
    """Write all usable detections; masks as uncompressed RLE."""
    write_json(path, [_format_detection(d) for d in detections if d.defect is None])


def _format_detection(d: Detection) -> dict[str, Any]:
    x0, y0, x1, y1 = d.bbox_xyxy
    entry = {
        "scene_id": d.scene_id,
        "image_id": d.im_id,
        "category_id": d.obj_id,
        "bbox": [x0 + 0.5, y0 + 0.5, x1 - x0, y1 - y0],  # index of the first pixel, the inverse of bop/scene.py
        "score": d.score,
        "time": d.time_s,
    }
    return entry if d.rle is None else entry | {"segmentation": to_uncompressed(d.rle)}
