"""Which pairs of points agree with one epipolar geometry, and when that question makes no sense."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float

_NEEDED = 8  # seven pairs define a fundamental matrix, so seven always agree
_PLANAR = 0.8  # of the epipolar inliers explained by a homography: ORB-SLAM (Mur-Artal, T-RO 2015) chooses it at 0.82
_COLLINEAR = 0.02  # ratio of the spreads across and along
_PLANAR_DRAWS = 200  # finds a plane that holds 40 % of the pairs with probability 0.99


def epipolar_inliers(
    a: Float[np.ndarray, "p 2"],
    b: Float[np.ndarray, "p 2"],
    *,
    threshold: float,
    iterations: int,
    seed: int,
) -> tuple[Bool[np.ndarray, " p"] | None, str]:
    """Pairs within ``threshold`` of their epipolar lines under the best RANSAC fundamental matrix, and "".

    None and the reason where there is no such matrix, or too many: fewer than 8 pairs, points on a line, pairs that a
    plane (or two views of almost the same direction) explains just as well. The seed shuffles the pairs, for OpenCV's
    RANSAC draws the same indices whatever cv2.setRNGSeed says.
    """
    if len(a) < _NEEDED:
        return None, f"{len(a)} pairs, a fundamental matrix needs {_NEEDED}"
    if min(_roundness(a), _roundness(b)) < _COLLINEAR:
        return None, "points nearly on a line"
    order = np.random.default_rng(seed).permutation(len(a))
    x, y = np.ascontiguousarray(a[order]), np.ascontiguousarray(b[order])
    F, agree = cv2.findFundamentalMat(x, y, cv2.FM_RANSAC, threshold, 0.99, iterations)
    if F is None or agree is None or agree.sum() < _NEEDED:
        return None, f"no fundamental matrix that {_NEEDED} of {len(a)} pairs agree with"
    H, planar = cv2.findHomography(x, y, cv2.RANSAC, threshold, maxIters=_PLANAR_DRAWS, confidence=0.99)
    if H is not None and planar.sum() >= _PLANAR * agree.sum():
        return (
            None,
            f"near-planar: {planar.sum()} pairs agree with a homography, {agree.sum()} with a fundamental matrix",
        )
    inliers = np.zeros(len(a), dtype=bool)
    inliers[order] = agree[:, 0].astype(bool)
    return inliers, ""


def _roundness(points: Float[np.ndarray, "p 2"]) -> float:
    along, across = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return float(across / along) if along > 0 else 0.0
