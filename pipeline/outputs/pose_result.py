"""An answer of the route -> the result for the user: a pose with its quality measures, or why there is none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from pipeline.items.objects import ObjectModel
from pipeline.items.poses import Alternative, NoEstimate, PoseEstimate
from pipeline.items.records import Answer
from pipeline.items.views import Image
from pipeline.report.overlay import DrawnPose, draw_overlay


@dataclass(frozen=True, eq=False)
class PoseResult:
    """The pose of one object in one image, or the reason why there is none.

    ``T_cam_obj``: 4 x 4, object to camera coordinates, mm; camera axes x right, y down, z forward (OpenCV). None
    if no pose was found; ``stage`` and ``reason`` then say what failed. ``score`` ranks estimates. ``confidence``: the
    probability that the pose is right, and ``decision`` what to do with it (accept, check or reject); None without a
    calibration. ``alternatives``: other poses that were found, best first. ``warnings``: possible problems with the
    mesh, camera, mask or box. ``correspondences``: point matches, of which ``inliers`` agree with the pose.
    ``times_s``: seconds by stage. ``mesh``: the mesh's file.
    """

    name: str
    T_cam_obj: Float[np.ndarray, "4 4"] | None
    score: float | None = None
    confidence: float | None = None
    decision: str | None = None
    alternatives: tuple[Alternative, ...] = ()
    stage: str | None = None
    reason: str | None = None
    warnings: tuple[str, ...] = ()
    inliers: int = 0
    correspondences: int = 0
    reprojection_px: float | None = None
    times_s: Mapping[str, float] = field(default_factory=dict)
    mesh: str = ""
    image: Image | None = field(default=None, repr=False)
    model: ObjectModel | None = field(default=None, repr=False)

    @property
    def found(self) -> bool:
        """Whether there is a pose."""
        return self.T_cam_obj is not None

    @property
    def quaternion_xyzw(self) -> Float[np.ndarray, " 4"] | None:
        """The pose's rotation as a unit quaternion x, y, z, w with w >= 0; None without a pose."""
        if self.T_cam_obj is None:
            return None
        return np.asarray(Rotation.from_matrix(self.T_cam_obj[:3, :3]).as_quat(canonical=True))

    @property
    def distance_mm(self) -> float | None:
        """Distance from the camera to the origin of the object frame; None without a pose."""
        return None if self.T_cam_obj is None else float(np.linalg.norm(self.T_cam_obj[:3, 3]))

    def overlay(self) -> UInt8[np.ndarray, "H W 3"]:
        """The image with the object's outline, 3D box and axes (x red, y green, z blue), drawn in its pose.

        An image smaller than 1000 px is enlarged by an integer factor.
        """
        return draw_results([self])

    def to_record(self) -> dict[str, Any]:
        """The result as an entry of ``poses`` in pose.json; docs/python.md explains the fields."""
        T, quaternion = self.T_cam_obj, self.quaternion_xyzw
        return {
            "name": self.name,
            "mesh": self.mesh,
            "status": "estimate" if self.found else "none",
            "T_cam_obj": None if T is None else T.tolist(),
            "quaternion_xyzw": None if quaternion is None else quaternion.tolist(),
            "distance_mm": self.distance_mm,
            "score": self.score,
            "confidence": self.confidence,
            "decision": self.decision,
            "alternatives": [
                {"T_cam_obj": other.T_cam_obj.tolist(), "support": other.support, "weight": other.weight}
                for other in self.alternatives
            ],
            "stage": self.stage,
            "reason": self.reason,
            "inliers": self.inliers,
            "correspondences": self.correspondences,
            "reprojection_px": self.reprojection_px,
        }

    def details(self) -> str:
        """The reprojection error and the seconds, for the terminal."""
        error = "" if self.reprojection_px is None else f", {self.reprojection_px:.2f} px apart"
        return f"{error}; {sum(self.times_s.values()):.1f} s"

    def summary(self) -> str:
        """One line: the name, then confidence and position of the pose, or the reason why there is none."""
        if self.T_cam_obj is None:
            return f"{self.name}: no pose: {self.stage}: {self.reason}"
        x, y, z = self.T_cam_obj[:3, 3]
        sure = f"score {self.score:.2f}" if self.confidence is None else f"confidence {self.confidence:.2f}"
        if self.decision is not None:
            sure += f" ({self.decision})"
        return f"{self.name}: {sure}, at {self.distance_mm:.0f} mm (x {x:.1f}, y {y:.1f}, z {z:.1f})"


def result_of(
    answer: Answer,
    name: str,
    *,
    mesh: str,
    image: Image,
    model: ObjectModel | None = None,
    warnings: Sequence[str] = (),
) -> PoseResult:
    """The result of an answer. Only with ``model`` can it be drawn."""
    if isinstance(answer, NoEstimate):
        stage, reason = answer.stage, answer.reason
        about = tuple(warnings)
        return PoseResult(name, None, stage=stage, reason=reason, warnings=about, mesh=mesh, image=image, model=model)
    return PoseResult(
        name,
        answer.T_cam_obj,
        score=answer.score,
        confidence=answer.confidence,
        decision=answer.decision or None,
        alternatives=answer.alternatives,
        warnings=(*warnings, *confidence_warnings(answer, name)),
        inliers=answer.inliers,
        correspondences=answer.correspondences,
        reprojection_px=answer.reprojection_px,
        times_s=answer.times_s,
        mesh=mesh,
        image=image,
        model=model,
    )


def confidence_warnings(estimate: PoseEstimate, name: str) -> tuple[str, ...]:
    """One line for a pose that is not to be used as it is: what to check."""
    sure = "" if estimate.confidence is None else f" (confidence {estimate.confidence:.2f})"
    if estimate.decision == "check":
        return (f"{name}: this pose may be wrong{sure}: look at the overlay before you use it",)
    if estimate.decision == "reject":
        causes = "mask and photograph that do not belong together, another object's mesh, a wrong unit or K"
        return (f"{name}: this pose is probably wrong{sure}: likely causes are a hidden object, {causes}",)
    return ()


def draw_results(results: Sequence[PoseResult]) -> UInt8[np.ndarray, "H W 3"]:
    """The image with the poses of all results, drawn as by PoseResult.overlay."""
    image = results[0].image
    assert image is not None
    poses = []
    for result in results:
        if result.T_cam_obj is not None and result.model is not None:
            sure = result.score if result.confidence is None else result.confidence
            label = f"{result.name}: {sure:.2f}"
            poses.append(DrawnPose(result.model.mesh, result.T_cam_obj, "unchecked", label, axes=True))
    return draw_overlay(image, poses, legend=False)
