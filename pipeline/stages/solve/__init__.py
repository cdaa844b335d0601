"""object points, image points, K -> pose."""

from __future__ import annotations

from typing import Annotated, Literal, Protocol

import numpy as np
from jaxtyping import Bool, Float
from pydantic import Field

from pipeline.errors import NoPose
from pipeline.functional.pnp import polish, reprojection_error_px
from pipeline.items.poses import PoseSolution
from pipeline.spec import Variant

Confidence = Annotated[float, Field(gt=0, lt=1)]
Plane = Literal["image", "crop"]
PnpPoints = Annotated[int, Field(ge=4)]  # three points leave up to four poses


class Solver(Variant, Protocol):
    """What a solve variant is.

    ``plane``: whose pixels and camera it is given, and so whose pixels its threshold means: the full ``image``'s, or
    the ``crop``'s, where a threshold is the same part of every object, near or far.
    """

    plane: Plane

    def __call__(
        self,
        points_obj: Float[np.ndarray, "m 3"],
        px_img: Float[np.ndarray, "m 2"],
        K: Float[np.ndarray, "3 3"],
    ) -> PoseSolution:
        """T_cam_obj (mm) from pixels of the camera K. Raises NoPose when no pose is supported by enough inliers."""
        ...


def usable(
    points_obj: Float[np.ndarray, "m 3"], px_img: Float[np.ndarray, "m 2"], *, needed: int
) -> Bool[np.ndarray, " m"]:
    """Correspondences without NaN or infinity. Raises NoPose for fewer than ``needed``."""
    finite = np.isfinite(points_obj).all(1) & np.isfinite(px_img).all(1)
    if finite.sum() < needed:
        raise NoPose("solve", f"{finite.sum()} correspondences, PnP needs {needed}")
    return finite


def solution(
    T_cam_obj: Float[np.ndarray, "4 4"] | None,
    points_obj: Float[np.ndarray, "m 3"],
    px_img: Float[np.ndarray, "m 2"],
    K: Float[np.ndarray, "3 3"],
    *,
    threshold_px: float,
    min_inliers: int,
    refine: bool,
) -> PoseSolution:
    """A solver's pose, polished when ``refine``, judged by its own reprojection: inliers are counted anew.

    Rows that are not finite are no inliers. Raises NoPose for no pose and for one with too few inliers.
    """
    finite = np.isfinite(points_obj).all(1) & np.isfinite(px_img).all(1)
    points, px = points_obj[finite], px_img[finite]
    if T_cam_obj is None:
        raise NoPose("solve", f"no pose brings {min_inliers} of {len(points)} points within {threshold_px:g} px")
    if refine:
        T_cam_obj = polish(points, px, K, T_cam_obj, threshold_px=threshold_px)
    error = reprojection_error_px(points, px, K, T_cam_obj)
    near = error < threshold_px
    if near.sum() < min_inliers:
        raise NoPose(
            "solve",
            f"best pose has {near.sum()} of {len(points)} points within {threshold_px:g} px, needs {min_inliers}",
        )
    inliers = np.zeros(len(points_obj), dtype=bool)
    inliers[finite] = near
    return PoseSolution(T_cam_obj, inliers, float(np.sqrt(np.mean(error[near] ** 2))))
