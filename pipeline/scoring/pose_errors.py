"""One estimate, one annotated instance -> all pose errors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32

from pipeline.bop.dataset import Dataset
from pipeline.bop.results import ResultRow
from pipeline.bop.scene import GroundTruth
from pipeline.functional.rigid import rotation_angle_deg
from pipeline.items.errors import PoseErrors
from pipeline.items.objects import Mesh, ObjectModel
from pipeline.metrics.pose_error import (
    add,
    adi,
    hull_vertices,
    mspd,
    mssd,
    rotation_error_deg,
    translation_error_mm,
)
from pipeline.metrics.recall import TAUS
from pipeline.metrics.vsd import vsd
from pipeline.stages.render.raycast import render_depth

MSPD_WIDTH_PX = 640
_PROBES = 128  # vertices for the lower bound of MSPD; more would take longer and hardly tighten it


class ScoringMesh:
    """An object's mesh without texture, with the vertices that its errors depend on."""

    def __init__(self, model: ObjectModel) -> None:
        self.vertices = model.mesh.vertices
        self.model = replace(model, mesh=Mesh(self.vertices, model.mesh.faces))  # all objects stay in memory
        self.hull = hull_vertices(self.vertices)
        self.probes = self.hull[np.linspace(0, len(self.hull) - 1, min(_PROBES, len(self.hull))).astype(int)]


@dataclass(frozen=True, eq=False)
class ScoredImage:
    """Camera and depth image of an image. ``depth_mm`` is None if VSD is not computed.

    Camera and width are read on first use: an image without estimates needs neither.
    """

    dataset: Dataset
    image_id: tuple[int, int]
    depth_mm: Float32[np.ndarray, "H W"] | None
    vsd_delta_mm: float

    @cached_property
    def K(self) -> Float[np.ndarray, "3 3"]:
        """Camera matrix."""
        return self.dataset.K(*self.image_id)

    @cached_property
    def mspd_scale(self) -> float:
        """Factor from pixels of this image to pixels of an image 640 px wide, in which BOP measures MSPD."""
        return MSPD_WIDTH_PX / self.dataset.image_width(*self.image_id)

    def render_depth(self, mesh: ScoringMesh, T_cam_obj: Float[np.ndarray, "4 4"]) -> Float32[np.ndarray, "H W"] | None:
        """Depth map of an object in this image, mm; None if VSD is not computed."""
        if self.depth_mm is None:
            return None
        return render_depth(mesh.model.mesh, self.K, T_cam_obj[None], self.depth_mm.shape)[0]


def compute_pose_errors(
    image: ScoredImage,
    mesh: ScoringMesh,
    index: int,
    row: ResultRow,
    gt: GroundTruth,
    truth_depth_mm: Float32[np.ndarray, "H W"] | None,
) -> PoseErrors:
    """All errors of estimate ``row``, number ``index`` of the results, against instance ``gt``."""
    model, T_est, T_gt = mesh.model, row.T_cam_obj, gt.T_cam_obj
    R_symmetric = T_gt[None, :3, :3] @ model.symmetries[:, :3, :3]
    angle_deg = rotation_angle_deg(np.broadcast_to(T_est[:3, :3], R_symmetric.shape), R_symmetric).min()
    mspd_px = mspd(T_est, T_gt, image.K, mesh.vertices, model.symmetries, mesh.probes)
    return PoseErrors(
        row=index,
        gt_id=gt.gt_id,
        diameter_mm=model.diameter_mm,
        vsd=_vsd_errors(image, mesh, T_est, truth_depth_mm),
        mssd_mm=mssd(T_est, T_gt, mesh.hull, model.symmetries),
        mspd_px=image.mspd_scale * mspd_px,
        add_mm=add(T_est, T_gt, mesh.vertices),
        adi_mm=adi(T_est, T_gt, mesh.vertices),
        rotation_deg=rotation_error_deg(T_est, T_gt),
        symmetric_rotation_deg=float(angle_deg),
        translation_mm=translation_error_mm(T_est, T_gt),
    )


def _vsd_errors(
    image: ScoredImage,
    mesh: ScoringMesh,
    T_est: Float[np.ndarray, "4 4"],
    truth_depth_mm: Float32[np.ndarray, "H W"] | None,
) -> tuple[float, ...] | None:
    """VSD by tolerance tau; None if it is not computed."""
    estimate_depth_mm = image.render_depth(mesh, T_est)
    if image.depth_mm is None or truth_depth_mm is None or estimate_depth_mm is None:
        return None
    errors = vsd(
        estimate_depth_mm,
        truth_depth_mm,
        image.depth_mm,
        image.K,
        diameter_mm=mesh.model.diameter_mm,
        delta_mm=image.vsd_delta_mm,
        taus=TAUS,
    )
    return tuple(errors.tolist())
