"""object points, image points, K -> pose, by LO-RANSAC P3P of PoseLib."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from pipeline.errors import BadInput
from pipeline.functional.pnp import reprojection_error_px
from pipeline.functional.rigid import nearest_rotation, rigid
from pipeline.spec import NonNegativeFloat, Positive, spec
from pipeline.stages.solve import RansacSolver


@spec
class Poselib(RansacSolver):
    """P3P in locally optimised RANSAC (Larsson, PoseLib).

    PoseLib's own local optimisation runs inside its RANSAC whatever ``refine`` says. ``refit_px``: scale, in
    pixels of the crop, of a Cauchy loss that the final pose is refitted with. The threshold has to be loose to find a
    pose among wrong matches; the loss then trusts near matches more than those close to the threshold. 0: off.
    """

    kind: ClassVar[str] = "solve.poselib"
    version: ClassVar[int] = 2
    added: ClassVar[Mapping[str, Any]] = {"refit_px": 0.0}

    iterations: Positive = 1000
    refit_px: NonNegativeFloat = 0.0

    def __post_init__(self) -> None:
        if find_spec("poselib") is None:
            raise BadInput("solve=poselib", found="poselib, which is not installed", needed="pip install poselib")

    def ransac(
        self, points_obj: Float[np.ndarray, "m 3"], px_img: Float[np.ndarray, "m 2"], K: Float[np.ndarray, "3 3"]
    ) -> Float[np.ndarray, "4 4"] | None:
        """See RansacSolver."""
        import poselib

        ransac = {
            "max_iterations": self.iterations,
            "min_iterations": min(100, self.iterations),
            "max_reproj_error": self.threshold_px,
            "success_prob": self.confidence,
            "seed": self.seed,
        }
        pose, found = poselib.estimate_absolute_pose(px_img, points_obj, _pinhole(K), ransac, {})
        if found["num_inliers"] == 0 or not np.isfinite(pose.Rt).all():
            return None
        return rigid(nearest_rotation(np.asarray(pose.R)), np.asarray(pose.t))

    @property
    def refits(self) -> bool:
        """See Solver."""
        return self.refit_px > 0

    def refit(
        self,
        points_obj: Float[np.ndarray, "m 3"],
        px_crop: Float[np.ndarray, "m 2"],
        K_crop: Float[np.ndarray, "3 3"],
        T_crop_obj: Float[np.ndarray, "4 4"],
    ) -> Float[np.ndarray, "4 4"]:
        """The minimum of a Cauchy loss over matches within three times its scale; unchanged with too few of them."""
        near = reprojection_error_px(points_obj, px_crop, K_crop, T_crop_obj) < 3 * self.refit_px
        if near.sum() < self.min_inliers:
            return T_crop_obj
        import poselib

        start = poselib.CameraPose()
        start.R, start.t = T_crop_obj[:3, :3], T_crop_obj[:3, 3]
        loss = {"loss_type": "CAUCHY", "loss_scale": self.refit_px}
        pose, _ = poselib.refine_absolute_pose(px_crop[near], points_obj[near], start, _pinhole(K_crop), loss)
        if not np.isfinite(pose.Rt).all():
            return T_crop_obj
        return rigid(nearest_rotation(np.asarray(pose.R)), np.asarray(pose.t))


def _pinhole(K: Float[np.ndarray, "3 3"]) -> dict[str, Any]:
    """PoseLib's camera of this matrix."""
    return {"model": "PINHOLE", "width": -1, "height": -1, "params": [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]}
