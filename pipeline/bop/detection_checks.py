"""Detections file + targets -> warnings, or an error when most entries share one mistake.

Each check cross-checks redundant information: ids against the targets, boxes against their images and masks.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from pipeline.bop.detections import Entry
from pipeline.bop.jsonio import is_number
from pipeline.bop.masks import decode_rle, polygon_corners, read_segmentation, rle_area, rle_bbox
from pipeline.errors import BadInput
from pipeline.items.views import Target

Xywh = tuple[float, float, float, float]

_MAX_CHECKED, _MAX_DECODED = 200, 20  # entries whose boxes are compared with their masks, and masks that are decoded
_AGREE, _FITS = 0.5, 0.7
"""Minimum IoU for box and mask to agree (a box of the full silhouette may exceed the visible mask), and for another box
format to explain a disagreement."""
_BEYOND = 0.03  # tolerance for polygons outside the image, as a share of its longer side
_OUTSIDE = 0.1  # share of a box outside the image above which it does not fit the image

_CORNERS = "two corners (x0, y0, x1, y1)"
_READINGS: dict[str, Callable[[Xywh], Xywh]] = {
    _CORNERS: lambda b: (b[0], b[1], b[2] - b[0], b[3] - b[1]),
    "centre and size": lambda b: (b[0] - b[2] / 2, b[1] - b[3] / 2, b[2], b[3]),
    "y before x": lambda b: (b[1], b[0], b[3], b[2]),
    "corners with y before x": lambda b: (b[1], b[0], b[3] - b[1], b[2] - b[0]),
}
_RELATIVE = "parts of the image's size (0..1)"
_ROW_MAJOR = "runs along rows"
_ELSEWHERE = "elsewhere"


def check_ids(path: Path, entries: Sequence[Entry], targets: Sequence[Target]) -> list[str]:
    """Warnings about ids that match few of the dataset's targets. Raises BadInput if no entry matches any."""
    if not entries:
        return [f"{path.name}: the file has no detections"]
    wanted = {(t.scene_id, t.im_id, t.obj_id) for t in targets}
    images = {key[:2] for key in wanted}
    found_images, found_objects = {e.target[:2] for e in entries}, {e.obj_id for e in entries}
    objects = {key[2] for key in wanted}
    causes = []
    if shift := _find_shift({(e.obj_id,) for e in entries}, {(o,) for o in objects}):
        causes.append(f"category_id looks shifted: object ids are {shift:+d}")
    if shift := _find_shift(found_images, images):
        causes.append(f"image_id looks shifted: image ids are {shift:+d}")
    if any(e.target in wanted for e in entries):
        is_sure = len(found_objects) > 1 or len(found_images) > 1  # a single id may be off by one by chance
        return [f"{path.name}: {cause}" for cause in causes] if is_sure else []
    if not found_objects & objects and not any("category_id" in cause for cause in causes):
        counts_from_0 = 0 in found_objects and 0 not in objects
        cause = "category_id counts from 0" if counts_from_0 else "a file of another dataset, or a detector's own ids"
        causes.append(f"{cause}? it must be the object's id")
    found = f"{len(entries)} detections of which none is of a target: {_list_ids(e.target for e in entries)}"
    hint = f" ({'; '.join(causes)})" if causes else ""
    raise BadInput(path, found=found, needed=f"those of the targets: {_list_ids(wanted)}{hint}")


def check_boxes_and_masks(
    path: Path, entries: Sequence[Entry], image_size: Callable[[int, int], tuple[int, int]]
) -> list[str]:
    """Warnings about boxes and masks of entries that belong to targets. ``image_size``: (scene_id, im_id) -> (h, w).

    Raises BadInput if most boxes are in another format, most masks are run-length encoded by rows instead of columns,
    or most boxes do not overlap their masks. Unreadable entries are left to the caller.
    """
    if not entries:
        return []
    step = -(-len(entries) // _MAX_CHECKED)
    sample = [(e, image_size(e.scene_id, e.im_id)) for e in entries[::step]]
    boxes = {e.index: box for e, _ in sample if (box := _get_box(e.record)) is not None}
    masks = {e.index: rle for e, size_hw in sample if (rle := _read_mask(e.record, size_hw)) is not None}
    warnings = []
    if not any(e.record.get("segmentation") for e in entries):
        warnings.append(
            f"{path.name}: no entry has a mask; poses from boxes see the background too and are less reliable"
        )
    _raise_if_most(path, {i: _RELATIVE for i, box in boxes.items() if _is_relative(box)}, len(boxes), boxes)
    decoded = dict(list(masks.items())[:_MAX_DECODED])
    by_rows = {i: _ROW_MAJOR for i, rle in decoded.items() if _runs_along_rows(decode_rle(rle))}
    _raise_if_most(path, by_rows, len(decoded), boxes)
    both = {i: (boxes[i], rle_bbox(rle)) for i, rle in masks.items() if i in boxes}
    faults = {i: fault for i, (box, mask_box) in both.items() if (fault := _compare(box, mask_box))}
    faults |= {i: _ROW_MAJOR for i in faults if i in decoded and _fits_by_rows(boxes[i], decode_rle(masks[i]))}
    _raise_if_most(path, faults, len(both), boxes)
    if faults:
        index, fault = next(iter(faults.items()))
        meaning = "lies beside its mask" if fault == _ELSEWHERE else f"does not fit its mask, but would as {fault}"
        warnings.append(
            f"{path.name}: {len(faults)} of {len(both)} boxes disagree with their masks (detection {index} {meaning})"
        )
    warnings += _check_polygons(path, sample)
    alone = [(e.index, boxes[e.index], size_hw) for e, size_hw in sample if e.index in boxes and e.index not in masks]
    return warnings + _check_against_images(path, alone)


def _check_polygons(path: Path, sample: Sequence[tuple[Entry, tuple[int, int]]]) -> list[str]:
    """A warning about polygons outside their images. Raises BadInput if all would fit with x and y exchanged."""
    read = ((e.index, _read_corners(e.record, hw), hw) for e, hw in sample)
    corners = {index: (found, hw) for index, found, hw in read if found is not None}
    outside = [index for index, (found, hw) in corners.items() if _leaves(found, hw)]
    if not outside:
        return []
    count = f"{len(outside)} of {len(corners)}"
    if not any(_leaves(found[:, ::-1], hw) for found, hw in corners.values()):
        found = f"polygons that look like y before x: all would fit their images so, and {count} leave them as x, y"
        found += f" (first: detection {outside[0]})"
        raise BadInput(f"{path}, field segmentation", found=found, needed="polygons [x, y, x, y, ...] in pixels")
    return [f"{path.name}: {count} polygons leave their images (detection {outside[0]}); are they of another size?"]


def _check_against_images(path: Path, boxes: Sequence[tuple[int, Xywh, tuple[int, int]]]) -> list[str]:
    """Warnings about boxes without masks. Raises BadInput if most exceed the image and all would fit as corners."""
    outside = [index for index, box, size_hw in boxes if _outside_share(box, size_hw) > _OUTSIDE]
    corners = sum(_are_corners(box, size_hw) for _, box, size_hw in boxes)
    if boxes and corners == len(boxes) and (2 * len(outside) > len(boxes) or len(boxes) > 2):
        index, box, (h, w) = next(item for item in boxes if not outside or item[0] == outside[0])
        found = (
            f"boxes that look like {_CORNERS}: all would fit their images as such, and {len(outside)} of {len(boxes)}"
        )
        found += f" leave them as x, y, width, height (detection {index}: {list(box)}, image of {w} x {h})"
        needed = "x, y, width, height, clipped to the image"
        if len(boxes) > 1 and 2 * len(outside) > len(boxes):
            raise BadInput(f"{path}, field bbox", found=found, needed=needed)
        return [f"{path.name}, field bbox: found {found}, needs {needed}"]
    if 2 * len(outside) > len(boxes):
        return [
            f"{path.name}: {len(outside)} of {len(boxes)} boxes leave their images; are they of images of another size?"
        ]
    return []


def _raise_if_most(path: Path, faults: dict[int, str], total: int, boxes: dict[int, Xywh]) -> None:
    """Raise BadInput if more than half of ``total`` entries have a fault; names the most frequent one."""
    if 2 * len(faults) <= total:
        return
    fault, count = Counter(faults.values()).most_common(1)[0]
    index = next(i for i, value in faults.items() if value == fault)
    if fault == _ROW_MAJOR:
        found = f"masks whose runs go along rows in {count} of {total} (first: detection {index})"
        raise BadInput(f"{path}, field segmentation", found=found, needed="COCO's RLE, whose runs go down the columns")
    example = f"{count} of {total}; detection {index}: {list(boxes[index])}"
    if fault == _ELSEWHERE:
        found = f"boxes that lie away from their masks ({example})"
        raise BadInput(f"{path}, field bbox", found=found, needed="box and mask of the same object in each entry")
    found = f"boxes that are {fault} ({example})"
    raise BadInput(f"{path}, field bbox", found=found, needed="x, y, width, height in pixels")


def _compare(box: Xywh, mask_box: Xywh) -> str:
    """The box format that would fit the mask, _ELSEWHERE if they do not overlap, "" if they may agree."""
    if _iou(box, mask_box) >= _AGREE:
        return ""
    reading, iou = max(((name, _iou(read(box), mask_box)) for name, read in _READINGS.items()), key=lambda r: r[1])
    if iou >= _FITS:
        return reading
    return _ELSEWHERE if _intersection(box, mask_box) <= 0.1 * mask_box[2] * mask_box[3] else ""


def _fits_by_rows(box: Xywh, mask: Bool[np.ndarray, "H W"]) -> bool:
    ys, xs = np.nonzero(_reread_by_rows(mask))
    x, y, w, h = (float(value) for value in (xs.min(), ys.min(), np.ptp(xs) + 1, np.ptp(ys) + 1))
    return _iou(box, (x, y, w, h)) >= _FITS


def _runs_along_rows(mask: Bool[np.ndarray, "H W"]) -> bool:
    """Whether the runs decode to a compact shape by rows, but to noise by columns."""
    return _perimeter(mask) > 2 * _perimeter(_reread_by_rows(mask))


def _reread_by_rows(mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """The same runs decoded by rows."""
    return mask.T.reshape(mask.shape)


def _perimeter(mask: Bool[np.ndarray, "H W"]) -> int:
    return int((mask[1:] != mask[:-1]).sum() + (mask[:, 1:] != mask[:, :-1]).sum())


def _get_box(record: dict[str, Any]) -> Xywh | None:
    box = record.get("bbox")
    if not isinstance(box, list) or len(box) != 4 or not all(is_number(v) and np.isfinite(v) for v in box):
        return None
    x, y, w, h = (float(v) for v in box)
    return x, y, w, h


def _read_mask(record: dict[str, Any], size_hw: tuple[int, int]) -> dict[str, Any] | None:
    try:
        rle = read_segmentation(record.get("segmentation"), size_hw)
    except ValueError:
        return None
    return rle if rle and rle_area(rle) else None


def _read_corners(record: dict[str, Any], size_hw: tuple[int, int]) -> Float[np.ndarray, "n 2"] | None:
    try:
        return polygon_corners(record.get("segmentation"), size_hw)
    except ValueError:
        return None


def _leaves(corners: Float[np.ndarray, "n 2"], size_hw: tuple[int, int]) -> bool:
    """Whether a corner lies outside the image by more than a tolerance."""
    h, w = size_hw
    beyond = np.maximum(-corners, corners - [w, h])
    return bool((beyond > _BEYOND * max(w, h)).any())


def _is_relative(box: Xywh) -> bool:
    return min(box) >= 0 and max(box) <= 1 and min(box[2:]) > 0


def _are_corners(box: Xywh, size_hw: tuple[int, int]) -> bool:
    """Whether the four numbers are two corners inside the image."""
    x0, y0, x1, y1 = box
    return 0 <= x0 < x1 <= size_hw[1] and 0 <= y0 < y1 <= size_hw[0]


def _outside_share(box: Xywh, size_hw: tuple[int, int]) -> float:
    area = box[2] * box[3]
    return 0.0 if area <= 0 else 1 - _intersection(box, (0.0, 0.0, float(size_hw[1]), float(size_hw[0]))) / area


def _intersection(a: Xywh, b: Xywh) -> float:
    """Area of the intersection; 0 for boxes of negative size."""
    w = min(a[0] + a[2], b[0] + b[2]) - max(a[0], b[0])
    h = min(a[1] + a[3], b[1] + b[3]) - max(a[1], b[1])
    return float(max(w, 0) * max(h, 0))


def _iou(a: Xywh, b: Xywh) -> float:
    common = _intersection(a, b)
    return common / (a[2] * a[3] + b[2] * b[3] - common) if common else 0.0


def _find_shift(found: set[Any], wanted: set[Any]) -> int:
    """The shift, 1 or -1, that makes the last number of every id match; 0 if they match already or neither helps."""
    if found <= wanted:
        return 0
    return next((s for s in (1, -1) if {(*key[:-1], key[-1] + s) for key in found} <= wanted), 0)


def _list_ids(keys: Iterable[tuple[int, int, int]]) -> str:
    names, columns = ("scenes", "images", "objects"), [sorted(set(column)) for column in zip(*keys, strict=True)]
    return ", ".join(f"{name} {_list_some(ids)}" for name, ids in zip(names, columns, strict=True))


def _list_some(ids: Sequence[int]) -> str:
    return " ".join(str(i)[:20] for i in ids[:8]) + (f" ... ({len(ids)})" if len(ids) > 8 else "")
