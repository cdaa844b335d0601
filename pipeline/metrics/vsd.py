"""depth of the estimate, of the ground truth and of the camera -> visible surface discrepancy."""

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
    """Visible surface discrepancy, 0 to 1, for every tolerance ``taus`` (parts of the diameter).

    Depth maps are along the optical axis, 0 where nothing is; those of the poses are rendered. Hodan et al., ECCVW
    2016, with the changes of ECCVW 2020: a pixel without measured depth counts as visible. 1 when nothing is visible.
    """
    rows, columns = _window((depth_est_mm > 0) | (depth_gt_mm > 0))
    offset = np.array([[0.0, 0.0, columns.start], [0.0, 0.0, rows.start], [0.0, 0.0, 0.0]])
    est, gt, test = (
        distance_map(depth[rows, columns], K - offset) for depth in (depth_est_mm, depth_gt_mm, depth_test_mm)
    )
    visible_gt = _visible(test, gt, delta_mm)
    visible_est = _visible(test, est, delta_mm) | (visible_gt & (est > 0))
    both, either = visible_gt & visible_est, int((visible_gt | visible_est).sum())
    if not either:
        return np.ones(len(taus))
    apart = np.abs(gt[both] - est[both]) / diameter_mm
    wrong = (apart[None] >= np.asarray(taus)[:, None]).sum(axis=1)
    return (wrong + either - int(both.sum())) / either


def distance_map(depth_mm: DepthMap, K: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "H W"]:
    """Distance from the camera's centre, mm, of a map of depth along the optical axis."""
    h, w = depth_mm.shape
    depth = depth_mm.astype(np.float64)
    x = depth * ((np.arange(w) - K[0, 2]) / K[0, 0])
    y = depth * ((np.arange(h) - K[1, 2]) / K[1, 1])[:, None]
    return np.sqrt(x**2 + y**2 + depth**2)


def _visible(
    test: Float[np.ndarray, "H W"], model: Float[np.ndarray, "H W"], delta_mm: float
) -> Bool[np.ndarray, "H W"]:
    """Where the model is in front of what the camera measured, or at most ``delta_mm`` behind, or nothing was measured.

    The difference is taken in float32, as bop_toolkit does: on the edge of ``delta_mm`` that decides.
    """
    behind = model.astype(np.float32) - test.astype(np.float32)
    return ((behind <= delta_mm) | (test == 0)) & (model > 0)


def _window(mask: Bool[np.ndarray, "H W"]) -> tuple[slice, slice]:
    """Rows and columns that hold all of a mask: outside of it nothing counts."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return slice(0, 0), slice(0, 0)
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
