"""Poses: the result of a solver, and the result of the route for a detection."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float


@dataclass(frozen=True, eq=False)
class PoseSolution:
    """A solved or refined pose, mm. After refinement, ``inliers`` are still those of the solver's pose.

    ``reprojection_px``: root mean square reprojection error of the inliers under T_cam_obj, in query image pixels.
    """

    T_cam_obj: Float[np.ndarray, "4 4"]
    inliers: Bool[np.ndarray, " m"]
    reprojection_px: float


Decision = Literal["accept", "check", "reject", ""]
"""What a robot should do with a pose; "" where the confidence is unknown."""


@dataclass(frozen=True, eq=False)
class Alternative:
    """Another pose (T_cam_obj, mm) that was found for a detection, further than 20 % of the diameter from the estimate.

    ``support``: its score relative to that of the estimate, 1 where it explains the picture as well. ``weight``: the
    probability that it is the right one; None where the confidence is unknown.
    """

    T_cam_obj: Float[np.ndarray, "4 4"]
    support: float
    weight: float | None = None


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """The pose of one detection, mm. ``score`` ranks the estimates of one object in one image; higher is better.

    ``template_margin``: as TemplateMatch.margin. ``fallback``: "" for a solved pose, otherwise what replaced it.
    ``notes``: what stages clamped or skipped. ``times_s``: seconds by stage. ``detection_id`` counts the detections of
    this object in this image; ``reprojection_px`` is None for a fallback. ``evidence``: what speaks for and against the
    pose, by name (see pipeline.confidence). ``alternatives``: best first. ``confidence``: probability that the largest
    distance of a surface point from its true place (MSSD) is below 20 % of the diameter, ``confidence_10``: below 10 %;
    None where no calibration fits the method.
    """

    scene_id: int
    im_id: int
    obj_id: int
    detection_id: int
    T_cam_obj: Float[np.ndarray, "4 4"]
    score: float
    detection_score: float
    template_id: int
    template_score: float
    template_margin: float
    correspondences: int
    inliers: int
    reprojection_px: float | None
    gt_id: int | None = None
    fallback: str = ""
    notes: tuple[str, ...] = ()
    times_s: Mapping[str, float] = field(default_factory=dict)
    evidence: Mapping[str, float] = field(default_factory=dict)
    alternatives: tuple[Alternative, ...] = ()
    confidence: float | None = None
    confidence_10: float | None = None
    decision: Decision = ""


@dataclass(frozen=True)
class NoEstimate:
    """Why a target has no pose: the stage that failed and its reason.

    ``detection_id`` is None if nothing was detected, ``template_id`` if no template was matched.
    """

    scene_id: int
    im_id: int
    obj_id: int
    stage: str
    reason: str
    detection_id: int | None = None
    gt_id: int | None = None
    template_id: int | None = None
