"""object points, image points, K -> pose."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field

from pipeline.errors import NoPose
from pipeline.functional.pnp import polish, reprojection_error_px
from pipeline.items.poses import PoseSolution
from pipeline.spec import NonNegative, Positive, PositiveFloat, Spec, spec

Confidence = Annotated[float, Field(gt=0, lt=1)]
Plane = Literal["image", "crop"]
PnpPoints = Annotated[int, Field(ge=4)]  # three points allow up to four poses


@spec
class Solver(Spec, ABC):
    """Contract of a solve variant.

    ``plane``: the pixel frame that its threshold is measured in. ``crop``: a threshold is the same share of every
    object, near or far. ``image``: pixels of the full image, scaled down where the crop is larger than 160 of them, so
    that a photograph of many megapixels does not make the threshold finer than the features (solve.plane).
    """

    plane: Plane = "image"

    @property
    def refits(self) -> bool:
        """Whether ``refit`` follows the solution."""
        return False

    @abstractmethod
    def __call__(
        self,
        points_obj: Float[np.ndarray, "m 3"],
        px_img: Float[np.ndarray, "m 2"],
        K: Float[np.ndarray, "3 3"],
    ) -> PoseSolution:
        """T_cam_obj (mm) from pixels of the camera K. Raises NoPose when no pose is supported by enough inliers."""

    def refit(
        self,
        points_obj: Float[np.ndarray, "m 3"],
        px_crop: Float[np.ndarray, "m 2"],
        K_crop: Float[np.ndarray, "3 3"],
        T_crop_obj: Float[np.ndarray, "4 4"],
    ) -> Float[np.ndarray, "4 4"]:
        """The pose refitted to matches in pixels of the crop, the scale of its features; unchanged by default."""
        return T_crop_obj


@spec
class RansacSolver(Solver):
    """Fields and steps that RANSAC solvers share.

    ``threshold_px``: an inlier's largest reprojection error. ``refine``: Levenberg-Marquardt on the inliers, kept only
    where it lowers the truncated squared error. ``seed``: of the draws.
    """

    iterations: Positive = 400
    threshold_px: PositiveFloat = 8.0
    confidence: Confidence = 0.999
    min_inliers: PnpPoints = 6
    refine: bool = True
    seed: NonNegative = 0

    @abstractmethod
    def ransac(
        self, points_obj: Float[np.ndarray, "m 3"], px_img: Float[np.ndarray, "m 2"], K: Float[np.ndarray, "3 3"]
    ) -> Float[np.ndarray, "4 4"] | None:
        """T_cam_obj (mm) of finite correspondences, None when no sample gives one."""

    def __call__(
        self,
        points_obj: Float[np.ndarray, "m 3"],
        px_img: Float[np.ndarray, "m 2"],
        K: Float[np.ndarray, "3 3"],
    ) -> PoseSolution:
        """The pose with its inliers, counted by reprojection; rows that are not finite are none.

        Raises NoPose for too few correspondences, for no pose, and for one with too few inliers.
        """
        finite = np.isfinite(points_obj).all(1) & np.isfinite(px_img).all(1)
        if finite.sum() < self.min_inliers:
            raise NoPose("solve", f"{finite.sum()} correspondences, PnP needs {self.min_inliers}")
        points, px = points_obj[finite], px_img[finite]
        T_cam_obj = self.ransac(points, px, K)
        if T_cam_obj is None:
            limit = f"within {self.threshold_px:g} px"
            raise NoPose("solve", f"no pose brings {self.min_inliers} of {len(points)} points {limit}")
        if self.refine:
            T_cam_obj = polish(points, px, K, T_cam_obj, threshold_px=self.threshold_px)
        error_px = reprojection_error_px(points, px, K, T_cam_obj)
        near = error_px < self.threshold_px
        if near.sum() < self.min_inliers:
            found = f"best pose has {near.sum()} of {len(points)} points within {self.threshold_px:g} px"
            raise NoPose("solve", f"{found}, needs {self.min_inliers}")
        inliers = np.zeros(len(points_obj), dtype=bool)
        inliers[finite] = near
        return PoseSolution(T_cam_obj, inliers, float(np.sqrt(np.mean(error_px[near] ** 2))))
