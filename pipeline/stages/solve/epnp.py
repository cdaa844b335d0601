"""object points, image points, K -> pose, by RANSAC EPnP of OpenCV."""

from __future__ import annotations

from typing import ClassVar

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.functional.pnp import pose_from_opencv
from pipeline.items.poses import PoseSolution
from pipeline.spec import NonNegative, Positive, PositiveFloat, Spec, spec
from pipeline.stages.solve import Confidence, Plane, PnpPoints, solution, usable


@spec
class Epnp(Spec):
    """EPnP (Lepetit et al., IJCV 2009) in RANSAC, polished on its inliers.

    ``refine``: Levenberg-Marquardt on the inliers, kept only where it lowers the truncated squared error; it also
    mends EPnP's weakness for flat sets of points. ``seed`` shuffles the correspondences: OpenCV's RANSAC draws the same
    indices every time, whatever cv2.setRNGSeed says.
    """

    kind: ClassVar[str] = "solve.epnp"
    version: ClassVar[int] = 2

    iterations: Positive = 400
    threshold_px: PositiveFloat = 8.0
    confidence: Confidence = 0.999
    min_inliers: PnpPoints = 6
    refine: bool = True
    seed: NonNegative = 0
    plane: Plane = "image"

    def __call__(
        self,
        points_obj: Float[np.ndarray, "m 3"],
        px_img: Float[np.ndarray, "m 2"],
        K: Float[np.ndarray, "3 3"],
    ) -> PoseSolution:
        """T_cam_obj (mm). Raises NoPose for too few correspondences and for poses with too few inliers."""
        index = np.flatnonzero(usable(points_obj, px_img, needed=self.min_inliers))
        index = np.random.default_rng(self.seed).permutation(index)
        return solution(
            self._ransac(points_obj[index], px_img[index], K),
            points_obj,
            px_img,
            K,
            threshold_px=self.threshold_px,
            min_inliers=self.min_inliers,
            refine=self.refine,
        )

    def _ransac(
        self, points_obj: Float[np.ndarray, "m 3"], px_img: Float[np.ndarray, "m 2"], K: Float[np.ndarray, "3 3"]
    ) -> Float[np.ndarray, "4 4"] | None:
        try:
            found, rvec, tvec, _ = cv2.solvePnPRansac(
                np.ascontiguousarray(points_obj, dtype=np.float64),
                np.ascontiguousarray(px_img, dtype=np.float64),
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
