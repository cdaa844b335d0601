"""object points, image points, K -> pose, by LO-RANSAC P3P of PoseLib."""

from __future__ import annotations

from importlib.util import find_spec
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from pipeline.errors import BadInput
from pipeline.functional.rigid import nearest_rotation, rigid
from pipeline.spec import Positive, spec
from pipeline.stages.solve import RansacSolver


@spec
class Poselib(RansacSolver):
    """P3P in locally optimised RANSAC (Larsson, PoseLib).

    PoseLib's own local optimisation runs inside its RANSAC whatever ``refine`` says.
    """

    kind: ClassVar[str] = "solve.poselib"
    version: ClassVar[int] = 2

    iterations: Positive = 1000

    def __post_init__(self) -> None:
        if find_spec("poselib") is None:
            raise BadInput("solve=poselib", found="poselib, which is not installed", needed="pip install poselib")

    def ransac(
        self, points_obj: Float[np.ndarray, "m 3"], px_img: Float[np.ndarray, "m 2"], K: Float[np.ndarray, "3 3"]
    ) -> Float[np.ndarray, "4 4"] | None:
        """See RansacSolver."""
        import poselib

        camera = {"model": "PINHOLE", "width": -1, "height": -1, "params": [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]}
        ransac = {
            "max_iterations": self.iterations,
            "min_iterations": min(100, self.iterations),
            "max_reproj_error": self.threshold_px,
            "success_prob": self.confidence,
            "seed": self.seed,
        }
        pose, found = poselib.estimate_absolute_pose(px_img, points_obj, camera, ransac, {})
        if found["num_inliers"] == 0 or not np.isfinite(pose.Rt).all():
            return None
        return rigid(nearest_rotation(np.asarray(pose.R)), np.asarray(pose.t))
