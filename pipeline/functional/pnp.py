"""Shared parts of the perspective-n-point solvers: errors and refinement of a pose. K has no skew."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float

from pipeline.functional.camera import project
from pipeline.functional.rigid import nearest_rotation, rigid, transform


def pose_from_opencv(rvec: Float[np.ndarray, "3 1"], tvec: Float[np.ndarray, "3 1"]) -> Float[np.ndarray, "4 4"] | None:
    """T_cam_obj from OpenCV's rotation vector and translation, None if they are not finite."""
    if not (np.isfinite(rvec).all() and np.isfinite(tvec).all()):
        return None
    return rigid(nearest_rotation(cv2.Rodrigues(rvec.reshape(3))[0]), tvec.reshape(3))


def reprojection_error_px(
    points_obj: Float[np.ndarray, "m 3"],
    px: Float[np.ndarray, "m 2"],
    K: Float[np.ndarray, "3 3"],
    T_cam_obj: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, " m"]:
    """Reprojection error of each point in pixels; infinite for a point that is not in front of the camera."""
    p = transform(T_cam_obj, points_obj)
    front = p[:, 2] > 0
    error = np.full(len(p), np.inf)
    error[front] = np.linalg.norm(project(K, p[front]) - px[front], axis=1)
    return error


def truncated_cost(error_px: Float[np.ndarray, " m"], *, threshold_px: float) -> float:
    """MSAC cost, px^2: sum of squared errors truncated at the threshold (Torr and Zisserman, CVIU 2000, Eq. 10)."""
    return float(np.square(np.minimum(error_px, threshold_px)).sum())


CONVERGED = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 20, float(np.finfo(float).eps))
"""Stopping criterion for OpenCV's solvers. Their default stops at float32's epsilon, on some CPUs 2e-6 mm too early."""


def least_squares_pose(
    points_obj: Float[np.ndarray, "m 3"],
    px: Float[np.ndarray, "m 2"],
    K: Float[np.ndarray, "3 3"],
    T_cam_obj: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, "4 4"] | None:
    """T_cam_obj that minimises the squared reprojection error, by Levenberg-Marquardt; None if it diverges."""
    rvec, tvec = cv2.Rodrigues(T_cam_obj[:3, :3])[0], T_cam_obj[:3, 3:].copy()
    try:
        return pose_from_opencv(*cv2.solvePnPRefineLM(points_obj, px, K, None, rvec, tvec, CONVERGED))
    except cv2.error:
        return None


def polish(
    points_obj: Float[np.ndarray, "m 3"],
    px: Float[np.ndarray, "m 2"],
    K: Float[np.ndarray, "3 3"],
    T_cam_obj: Float[np.ndarray, "4 4"],
    *,
    threshold_px: float,
    rounds: int = 3,
) -> Float[np.ndarray, "4 4"]:
    """T_cam_obj refitted to its inliers, up to ``rounds`` times; the truncated cost never increases."""
    error = reprojection_error_px(points_obj, px, K, T_cam_obj)
    for _ in range(rounds):
        inliers: Bool[np.ndarray, " m"] = error < threshold_px
        if inliers.sum() < 4:
            break
        refitted = least_squares_pose(points_obj[inliers], px[inliers], K, T_cam_obj)
        if refitted is None:
            break
        error_after = reprojection_error_px(points_obj, px, K, refitted)
        if truncated_cost(error_after, threshold_px=threshold_px) >= truncated_cost(error, threshold_px=threshold_px):
            break
        T_cam_obj, error = refitted, error_after
    return T_cam_obj
