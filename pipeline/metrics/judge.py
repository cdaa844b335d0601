"""estimate, ground truth -> its errors. For tables and overlays of one run; AR is computed elsewhere, as BOP does."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

from pipeline.functional.rigid import rotation_angle_deg
from pipeline.items.objects import ObjectModel
from pipeline.items.poses import PoseEstimate
from pipeline.metrics.pose_error import mssd, translation_error_mm

CORRECT_MSSD = 0.2
"""Tables and overlays of one run call a pose right when its MSSD is below this part of the diameter."""


@dataclass(frozen=True)
class Judged:
    """Errors against instance ``gt_id``; rotation and MSSD are those of the symmetry that fits best."""

    gt_id: int
    rotation_deg: float
    translation_mm: float
    mssd_mm: float
    diameter_mm: float

    @property
    def relative_mssd(self) -> float:
        """MSSD as a part of the diameter."""
        return self.mssd_mm / self.diameter_mm

    @property
    def correct(self) -> bool:
        """Whether it counts as right in tables and overlays."""
        return self.relative_mssd < CORRECT_MSSD

    def as_record(self) -> dict[str, float]:
        """JSON-able."""
        return asdict(self)


def judge(estimate: PoseEstimate, truths: Mapping[int, Float[np.ndarray, "4 4"]], model: ObjectModel) -> Judged:
    """Errors against the instance the detection was made of, or else the one with the smallest MSSD."""
    if estimate.gt_id is not None and estimate.gt_id in truths:
        truths = {estimate.gt_id: truths[estimate.gt_id]}
    outer = _outer_vertices(model.mesh.vertices)
    errors = {gt_id: mssd(estimate.T_cam_obj, T, outer, model.symmetries) for gt_id, T in truths.items()}
    gt_id = min(errors, key=lambda i: errors[i])
    R_gt = truths[gt_id][None, :3, :3] @ model.symmetries[:, :3, :3]
    angles = rotation_angle_deg(np.broadcast_to(estimate.T_cam_obj[:3, :3], R_gt.shape), R_gt)
    distance = translation_error_mm(estimate.T_cam_obj, truths[gt_id])
    return Judged(gt_id, float(angles.min()), float(distance), float(errors[gt_id]), model.diameter_mm)


def _outer_vertices(vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "h 3"]:
    """Vertices of the convex hull, where distances between two placements are largest: MSSD is exact on them."""
    try:
        return vertices[ConvexHull(vertices).vertices]
    except QhullError:  # a flat object has no hull in 3D
        return vertices
