"""depth maps of estimate, ground truth and camera -> visible surface discrepancy (VSD)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Num

DepthMap = Num[np.ndarray, "H W"]


def vsd(
    depth_est_mm: DepthMap,
    depth_gt_mm: DepthMap,
    depth_test_mm: DepthMap,
    K: Float[np.ndarray, "3 3"],
    *,
    diameter_mm: float,
    delta_mm: float,
    taus: Float[np.ndarray, " t"],
) -> Float[np.ndarray, " t"]:
    """Visible surface discrepancy, 0 to 1, for each tolerance in ``taus`` (fractions of the diameter).

    Depth is along the optical axis, 0 where there is none; the poses' depth maps are rendered. Hodan et al., ECCVW
    2016, with the changes of ECCVW 2020: pixels without measured depth count as visible. 1 if nothing is visible.
    """
    rows, columns = _bounding_slices((depth_est_mm > 0) | (depth_gt_mm > 0))
    offset = np.array([[0.0, 0.0, columns.start], [0.0, 0.0, rows.start], [0.0, 0.0, 0.0]])
    est, gt, test = (
        distance_map(depth[rows, columns], K - offset) for depth in (depth_est_mm, depth_gt_mm, depth_test_mm)
    )
    visible_gt = _visibility_mask(test, gt, delta_mm)
    visible_est = _visibility_mask(test, est, delta_mm) | (visible_gt & (est > 0))
    both, either = visible_gt & visible_est, int((visible_gt | visible_est).sum())
    if not either:
        return np.ones(len(taus))
    difference = np.abs(gt[both] - est[both]) / diameter_mm
    wrong = (difference[None] >= np.asarray(taus)[:, None]).sum(axis=1)
    return (wrong + either - int(both.sum())) / either


def distance_map(depth_mm: DepthMap, K: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "H W"]:
    """Distances from the camera centre, mm, from depths along the optical axis."""
    h, w = depth_mm.shape
    depth = depth_mm.astype(np.float64)
    x = depth * ((np.arange(w) - K[0, 2]) / K[0, 0])
    y = depth * ((np.arange(h) - K[1, 2]) / K[1, 1])[:, None]
    return np.sqrt(x**2 + y**2 + depth**2)


def _visibility_mask(
    test: Float[np.ndarray, "H W"], model: Float[np.ndarray, "H W"], delta_mm: float
) -> Bool[np.ndarray, "H W"]:
    """Pixels where the model is visible: at most ``delta_mm`` behind the measured surface, or nothing was measured.

    The difference is in float32 as in bop_toolkit, which decides pixels exactly at ``delta_mm``.
    """
    behind = model.astype(np.float32) - test.astype(np.float32)
    return ((behind <= delta_mm) | (test == 0)) & (model > 0)


def _bounding_slices(mask: Bool[np.ndarray, "H W"]) -> tuple[slice, slice]:
    """Rows and columns of a mask's bounding box."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return slice(0, 0), slice(0, 0)
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
