"""Poses, detections and proposals as JSON records, and back. The one place that knows the field names on disk."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any

import numpy as np

from pipeline.items.poses import NoEstimate, PoseEstimate
from pipeline.items.views import Detection, Proposal

Answer = PoseEstimate | NoEstimate


def answer_to_record(answer: Answer) -> dict[str, Any]:
    """A JSON-able record; ``status`` is "estimate" or "none"."""
    if isinstance(answer, NoEstimate):
        return {"status": "none", **asdict(answer)}
    values = {f.name: getattr(answer, f.name) for f in fields(answer)}
    values["T_cam_obj"] = np.asarray(answer.T_cam_obj, float).tolist()
    values["notes"] = list(answer.notes)
    values["times_s"] = {stage: round(seconds, 6) for stage, seconds in answer.times_s.items()}
    return {"status": "estimate", **values}


def answer_from_record(record: Mapping[str, Any]) -> Answer:
    """The answer a record holds."""
    values = {name: value for name, value in record.items() if name != "status"}
    if record["status"] == "none":
        return NoEstimate(**values)
    values["T_cam_obj"] = np.array(values["T_cam_obj"], float)
    values["notes"] = tuple(values["notes"])
    return PoseEstimate(**values)


def detection_to_record(detection: Detection) -> dict[str, Any]:
    """A JSON-able record of a detection."""
    return asdict(detection) | {"bbox_xyxy": list(detection.bbox_xyxy)}


def detection_from_record(record: Mapping[str, Any]) -> Detection:
    """The detection a record holds."""
    x0, y0, x1, y1 = record["bbox_xyxy"]
    return Detection(**{**record, "bbox_xyxy": (x0, y0, x1, y1)})


def proposal_to_record(proposal: Proposal) -> dict[str, Any]:
    """A JSON-able record of a proposal."""
    return asdict(proposal) | {"bbox_xyxy": list(proposal.bbox_xyxy)}


def proposal_from_record(record: Mapping[str, Any]) -> Proposal:
    """The proposal a record holds."""
    x0, y0, x1, y1 = record["bbox_xyxy"]
    return Proposal(**{**record, "bbox_xyxy": (x0, y0, x1, y1)})
