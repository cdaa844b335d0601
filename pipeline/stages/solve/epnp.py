"""object points, image points, K -> pose, by RANSAC EPnP of OpenCV."""

from __future__ import annotations

from typing import ClassVar

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.functional.pnp import pose_from_opencv
from pipeline.spec import spec
from pipeline.stages.solve import RansacSolver


@spec
class Epnp(RansacSolver):
    """EPnP (Lepetit et al., IJCV 2009) in RANSAC, refined on its inliers.

    ``refine`` also makes up for EPnP's weakness with planar sets of points. ``seed`` shuffles the correspondences:
    OpenCV's RANSAC draws the same indices every time, whatever cv2.setRNGSeed is given.
    """

    kind: ClassVar[str] = "solve.epnp"
    version: ClassVar[int] = 2

    def ransac(
        self, points_obj: Float[np.ndarray, "m 3"], px_img: Float[np.ndarray, "m 2"], K: Float[np.ndarray, "3 3"]
    ) -> Float[np.ndarray, "4 4"] | None:
        """See RansacSolver."""
        order = np.random.default_rng(self.seed).permutation(len(points_obj))
        try:
            found, rvec, tvec, _ = cv2.solvePnPRansac(
                np.ascontiguousarray(points_obj[order], dtype=np.float64),
                np.ascontiguousarray(px_img[order], dtype=np.float64),
                np.asarray(K, dtype=np.float64),
                None,
                iterationsCount=self.iterations,
                reprojectionError=self.threshold_px,
                confidence=self.confidence,
                flags=cv2.SOLVEPNP_EPNP,
            )
        except cv2.error:  # sets without extent
            return None
        return pose_from_opencv(rvec, tvec) if found else None
