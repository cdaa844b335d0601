"""Detections -> a JSON file in the format of BOP's default detections, which ``detect=json`` reads."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.bop.masks import to_uncompressed
from pipeline.io.files import write_json
from pipeline.items.views import Detection


def write_detections(path: Path, detections: Sequence[Detection]) -> None:
    """Write all detections without a defect; masks as uncompressed RLE."""
    write_json(path, [_format_detection(d) for d in detections if d.defect is None])


def _format_detection(d: Detection) -> dict[str, Any]:
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
