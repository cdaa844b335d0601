"""Point pairs that agree with one epipolar geometry, and detection of degenerate configurations."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float

PlanarMode = Literal["skip", "fundamental", "homography"]

_MIN_PAIRS = 8  # seven pairs determine a fundamental matrix, so seven always agree
_PLANAR = 0.8  # homography inliers / epipolar inliers; ORB-SLAM (Mur-Artal, T-RO 2015) uses a ratio equivalent to 0.82
_COLLINEAR = 0.02  # smaller singular value / larger one of the centred points
_PLANAR_ITERATIONS = 200  # finds a plane that holds 40 % of the pairs with probability 0.99


def epipolar_inliers(
    a: Float[np.ndarray, "p 2"],
    b: Float[np.ndarray, "p 2"],
    *,
    threshold: float,
    iterations: int,
    seed: int,
    planar: PlanarMode = "skip",
) -> tuple[Bool[np.ndarray, " p"] | None, str]:
    """Inliers within ``threshold`` pixels of their epipolar lines under a RANSAC fundamental matrix, and "".

    Returns None and the reason where no fundamental matrix is found: fewer than 8 pairs, or 8 that agree. ``planar`` is
    for pairs that do not determine it, because a homography explains them equally well (a planar object, or almost no
    baseline) or because points are nearly collinear: ``skip`` returns None and the reason; ``homography`` returns the
    inliers of the homography, None for collinear points; ``fundamental`` returns those of the matrix that was found.
    The seed shuffles the pairs because OpenCV's RANSAC ignores cv2.setRNGSeed.
    """
    if len(a) < _MIN_PAIRS:
        return None, f"{len(a)} pairs, a fundamental matrix needs {_MIN_PAIRS}"
    if planar != "fundamental" and min(_spread_ratio(a), _spread_ratio(b)) < _COLLINEAR:
        return None, "points nearly on a line"
    order = np.random.default_rng(seed).permutation(len(a))
    x, y = np.ascontiguousarray(a[order]), np.ascontiguousarray(b[order])
    F, agree = cv2.findFundamentalMat(x, y, cv2.FM_RANSAC, threshold, 0.99, iterations)
    if F is None or agree is None or agree.sum() < _MIN_PAIRS:
        return None, f"no fundamental matrix that {_MIN_PAIRS} of {len(a)} pairs agree with"
    if planar != "fundamental":
        H, on_plane = cv2.findHomography(x, y, cv2.RANSAC, threshold, maxIters=_PLANAR_ITERATIONS, confidence=0.99)
        if H is not None and on_plane.sum() >= _PLANAR * agree.sum():
            if planar == "skip":
                with_plane = f"{on_plane.sum()} pairs agree with a homography"
                return None, f"near-planar: {with_plane}, {agree.sum()} with a fundamental matrix"
            agree = on_plane
    inliers = np.zeros(len(a), dtype=bool)
    inliers[order] = agree[:, 0].astype(bool)
    return inliers, ""


def _spread_ratio(points: Float[np.ndarray, "p 2"]) -> float:
    """Spread across the points' main direction divided by the spread along it: 0 for collinear points, at most 1."""
    along, across = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return float(across / along) if along > 0 else 0.0
