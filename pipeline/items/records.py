"""Conversion of items to JSON records and back. The only module that knows their field names on disk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from typing import Any

import numpy as np
from jaxtyping import Bool

from pipeline.items.errors import PoseErrors
from pipeline.items.poses import Alternative, NoEstimate, PoseEstimate
from pipeline.items.scores import Scores
from pipeline.items.views import Detection, Proposal

Answer = PoseEstimate | NoEstimate
"""Result of the online route for one detection."""


def answer_to_record(answer: Answer) -> dict[str, Any]:
    """A pose estimate, or the lack of one; ``status`` is "estimate" or "none"."""
    if isinstance(answer, NoEstimate):
        return {"status": "none", **asdict(answer)}
    values = {f.name: getattr(answer, f.name) for f in fields(answer)}
    values["T_cam_obj"] = np.asarray(answer.T_cam_obj, float).tolist()
    values["notes"] = list(answer.notes)
    values["evidence"] = dict(answer.evidence)
    values["alternatives"] = [
        {"T_cam_obj": np.asarray(a.T_cam_obj, float).tolist(), "support": a.support, "weight": a.weight}
        for a in answer.alternatives
    ]
    values["times_s"] = {stage: round(seconds, 6) for stage, seconds in answer.times_s.items()}
    return {"status": "estimate", **values}


def answer_from_record(record: Mapping[str, Any]) -> Answer:
    """Inverse of ``answer_to_record``."""
    values = {name: value for name, value in record.items() if name != "status"}
    if record["status"] == "none":
        return NoEstimate(**values)
    values["T_cam_obj"] = np.array(values["T_cam_obj"], float)
    values["notes"] = tuple(values["notes"])
    values["alternatives"] = tuple(
        Alternative(**(record | {"T_cam_obj": np.array(record["T_cam_obj"], float)}))
        for record in values.get("alternatives", ())
    )
    return PoseEstimate(**values)


def detection_to_record(detection: Detection) -> dict[str, Any]:
    """A detection's fields; the box as a list, ``guessed`` only where it is true."""
    record = asdict(detection) | {"bbox_xyxy": list(detection.bbox_xyxy)}
    if not detection.guessed:
        del record["guessed"]
    return record


def detection_from_record(record: Mapping[str, Any]) -> Detection:
    """Inverse of ``detection_to_record``."""
    x0, y0, x1, y1 = record["bbox_xyxy"]
    return Detection(**{**record, "bbox_xyxy": (x0, y0, x1, y1)})


def proposal_to_record(proposal: Proposal) -> dict[str, Any]:
    """A proposal's fields; the box as a list."""
    return asdict(proposal) | {"bbox_xyxy": list(proposal.bbox_xyxy)}


def proposal_from_record(record: Mapping[str, Any]) -> Proposal:
    """Inverse of ``proposal_to_record``."""
    x0, y0, x1, y1 = record["bbox_xyxy"]
    return Proposal(**{**record, "bbox_xyxy": (x0, y0, x1, y1)})


def scores_to_record(scores: Scores) -> dict[str, Any]:
    """Scores, with each instance's hits as bits in hexadecimal."""
    visible = [None if np.isnan(v) else round(float(v), 6) for v in scores.visib_fract]
    return {
        "instances": scores.instances(),
        "visib_fract": visible,
        "mssd": _to_hex(scores.mssd),
        "mspd": _to_hex(scores.mspd),
        "vsd": None if scores.vsd is None else _to_hex(scores.vsd.reshape(len(scores), 100)),
        "no_vsd": scores.no_vsd,
    }


def scores_from_record(record: Mapping[str, Any]) -> Scores:
    """Inverse of ``scores_to_record``. Raises ValueError for columns of different lengths."""
    scene_id, im_id, obj_id, gt_id = np.array(record["instances"], dtype=np.int64).reshape(-1, 4).T
    visible = np.array([np.nan if v is None else v for v in record["visib_fract"]], dtype=np.float64)
    if not {len(record[name]) for name in ("visib_fract", "mssd", "mspd")} <= {len(scene_id)}:
        raise ValueError("scores of another number of instances")
    mssd, mspd = _from_hex(record["mssd"], 10), _from_hex(record["mspd"], 10)
    vsd = None if record["vsd"] is None else _from_hex(record["vsd"], 100).reshape(len(scene_id), 10, 10)
    return Scores(scene_id, im_id, obj_id, gt_id, visible, mssd, mspd, vsd, record["no_vsd"])


def errors_to_record(errors: PoseErrors) -> dict[str, Any]:
    """Pose errors; infinite values become null."""
    values = asdict(errors) | {"vsd": None if errors.vsd is None else list(errors.vsd)}
    return {n: None if isinstance(v, float) and not np.isfinite(v) else v for n, v in values.items()}


def errors_from_record(record: Mapping[str, Any]) -> PoseErrors:
    """Inverse of ``errors_to_record``."""
    values: dict[str, Any] = {name: np.inf if value is None else value for name, value in record.items()}
    values["vsd"] = None if record["vsd"] is None else tuple(record["vsd"])
    return PoseErrors(**values)


def _to_hex(bits: Bool[np.ndarray, "n k"]) -> list[str]:
    return [np.packbits(row).tobytes().hex() for row in bits]


def _from_hex(rows: Sequence[str], count: int) -> Bool[np.ndarray, "n k"]:
    packed = np.array([list(bytes.fromhex(row)) for row in rows], dtype=np.uint8).reshape(len(rows), (count + 7) // 8)
    return np.unpackbits(packed, axis=1, count=count).astype(bool)
