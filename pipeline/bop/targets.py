"""Targets file or annotations -> targets: which objects to find in which images, and how many of each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from pipeline.bop.jsonio import abbreviate, describe_place, get_integer
from pipeline.bop.scene import Scene
from pipeline.errors import BadInput
from pipeline.items.views import Target


def names_images_only(records: Any) -> bool:
    """Whether these are targets of BOP24's detection tasks: images, without the objects to find there."""
    return isinstance(records, list) and bool(records) and all(_is_image(record) for record in records)


def _is_image(record: Any) -> bool:
    return isinstance(record, dict) and {"scene_id", "im_id"} <= record.keys() and "obj_id" not in record


def parse_images(path: Path, records: Sequence[Any]) -> set[tuple[int, int]]:
    """(scene_id, im_id) of each entry of a targets file. Raises BadInput."""
    images = set()
    for index, record in enumerate(records):
        where = describe_place(path, target=index)
        images.add((get_integer(record, "scene_id", where), get_integer(record, "im_id", where)))
    return images


def parse_targets(path: Path, records: Any) -> tuple[Target, ...]:
    """The targets of a targets file, sorted. Raises BadInput for an entry that is incomplete or repeated."""
    if not isinstance(records, list) or not records:
        raise BadInput(path, found=abbreviate(records), needed="a list of targets: scene_id, im_id, obj_id, inst_count")
    targets = []
    for index, record in enumerate(records):
        where = describe_place(path, target=index)
        ids = [get_integer(record, name, where) for name in ("scene_id", "im_id", "obj_id", "inst_count")]
        if min(ids) < 0 or ids[-1] < 1:
            raise BadInput(where, found=abbreviate(record), needed="ids >= 0 and inst_count >= 1")
        targets.append(Target(*ids))
    repeated = [key for key, n in Counter((t.scene_id, t.im_id, t.obj_id) for t in targets).items() if n > 1]
    if repeated:
        scene_id, im_id, obj_id = repeated[0]
        where = describe_place(path, scene=scene_id, image=im_id, object=obj_id)
        raise BadInput(where, found="the target twice", needed="one entry with its inst_count")
    return _sort_targets(targets)


def count_instances(images: Iterable[tuple[Scene, int]]) -> tuple[Target, ...]:
    """One target per object and image (scene, im_id), with as many instances as are annotated, sorted."""
    targets = []
    for scene, im_id in images:
        counts = Counter(gt.obj_id for gt in scene.ground_truth(im_id))
        targets += [Target(scene.scene_id, im_id, obj_id, n) for obj_id, n in counts.items()]
    return _sort_targets(targets)


def _sort_targets(targets: Sequence[Target]) -> tuple[Target, ...]:
    return tuple(sorted(targets, key=lambda t: (t.scene_id, t.im_id, t.obj_id)))
