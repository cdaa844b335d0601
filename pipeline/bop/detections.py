"""Detections -> a file in the json of BOP's default detections, which ``detect=json`` reads back."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.bop.masks import to_uncompressed
from pipeline.io.files import write_json
from pipeline.items.views import Detection


def write_detections(path: Path, detections: Sequence[Detection]) -> None:
    """Every detection that can be used, with its mask as uncompressed RLE where it has one."""
    write_json(path, [_entry(d) for d in detections if d.defect is None])


def _entry(d: Detection) -> dict[str, Any]:
    x0, y0, x1, y1 = d.bbox_xyxy
    entry = {
        "scene_id": d.scene_id,
        "image_id": d.im_id,
        "category_id": d.obj_id,
        "bbox": [x0 + 0.5, y0 + 0.5, x1 - x0, y1 - y0],  # the first pixel, as bop/scene.py reads it
        "score": d.score,
        "time": d.time_s,
    }
    return entry if d.rle is None else entry | {"segmentation": to_uncompressed(d.rle)}
