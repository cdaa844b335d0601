"""trace -> evidence for and against a pose, computed without ground truth: the input of its confidence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.items.features import PairGeometry
from pipeline.items.objects import ObjectModel
from pipeline.items.online import Hypothesis, Query, Trace
from pipeline.items.poses import Alternative
from pipeline.metrics.pose_error import hull_vertices, mssd
from pipeline.stages.choose import compare_features

NEAR = 0.2
"""Poses whose MSSD is below this share of the diameter count as the same pose."""
MOST_ALTERNATIVES = 4
_LEAST_SUPPORT = 0.3
_EXTENT_POINTS = 48


@dataclass(frozen=True, eq=False)
class Extent:
    """The outermost points (mm) and symmetries of an object, for measuring the distance between two poses."""

    points: Float[np.ndarray, "p 3"]
    symmetries: Float[np.ndarray, "s 4 4"]
    diameter_mm: float

    def distance(self, T_a: Float[np.ndarray, "4 4"], T_b: Float[np.ndarray, "4 4"]) -> float:
        """MSSD of two poses, divided by the diameter; symmetric copies have distance 0."""
        return mssd(T_a, T_b, self.points, self.symmetries) / self.diameter_mm


def measure_extent(model: ObjectModel) -> Extent:
    """The extent of an object: 48 vertices of its convex hull, by farthest point sampling."""
    hull = hull_vertices(model.mesh.vertices)
    chosen = [int(np.argmax(np.linalg.norm(hull - hull.mean(axis=0), axis=1)))]
    nearest = np.full(len(hull), np.inf)
    while len(chosen) < min(_EXTENT_POINTS, len(hull)):
        nearest = np.minimum(nearest, np.linalg.norm(hull - hull[chosen[-1]], axis=1))
        chosen.append(int(nearest.argmax()))
    return Extent(hull[chosen], model.symmetries, model.diameter_mm)


def collect_evidence(
    trace: Trace, query: Query, geometry: PairGeometry, extent: Extent
) -> tuple[dict[str, float], tuple[Alternative, ...]]:
    """Evidence for the trace's best pose, by name, and the alternatives, best first.

    ``geometry``: of the best hypothesis. Quantities that a method does not compute are missing.
    """
    others, rivals = _compare_hypotheses(trace, extent)
    found = _count_matches(trace.best, query)
    if trace.best.solution is not None:
        found["cosine"], found["coverage"] = compare_features(trace.best.solution.T_cam_obj, geometry)
    found |= _compare_silhouettes(trace.best, query, extent)
    found["template_score"] = trace.best.template_score
    found["template_margin"] = trace.match.margin
    if trace.best.score is not None:
        found["value"] = trace.best.score
    if others:
        found["agreeing"] = 1 - sum(others) / len(others)
        found["rival"] = max((rival.support for rival in rivals), default=0.0)
    return {name: float(value) for name, value in found.items()}, tuple(rivals)


def _compare_hypotheses(trace: Trace, extent: Extent) -> tuple[list[bool], list[Alternative]]:
    """For each other hypothesis, whether it disagrees with the best; and those that do, without near duplicates."""
    best, disagrees, rivals = trace.best, list[bool](), list[Alternative]()
    for other in trace.hypotheses[1:]:
        if other.solution is None or best.solution is None:
            continue
        T_other = other.solution.T_cam_obj
        far = extent.distance(T_other, best.solution.T_cam_obj) >= NEAR
        disagrees.append(far)
        if far:
            rivals.append(Alternative(T_other, _relative_score(other, best)))
    distinct: list[Alternative] = []
    for rival in sorted(rivals, key=lambda r: -r.support):
        if rival.support < _LEAST_SUPPORT or len(distinct) == MOST_ALTERNATIVES:
            break
        if all(extent.distance(rival.T_cam_obj, kept.T_cam_obj) >= NEAR for kept in distinct):
            distinct.append(rival)
    return disagrees, distinct


def _relative_score(other: Hypothesis, best: Hypothesis) -> float:
    """Score of a hypothesis relative to the best one's, both from before or both from after the rerender."""
    ours, reference = other, best
    if other.rerendered is None and best.first is not None:
        reference = best.first
    if ours.score is None or not reference.score or reference.score < 0:
        return 0.0
    return float(np.clip(ours.score / reference.score, 0.0, 2.0))


def _count_matches(best: Hypothesis, query: Query) -> dict[str, float]:
    if best.solution is None or best.matches is None:
        return {}
    count = len(best.matches.similarity)
    inlying = best.solution.inliers
    similarity = best.matches.similarity.float().cpu().numpy()
    zoom = float(np.sqrt(abs(np.linalg.det(query.A_crop_img))))
    return {
        "inliers": best.inliers,
        "inlier_ratio": best.inliers / max(count, 1),
        "reprojection": best.solution.reprojection_px * zoom / query.crop.mask.shape[-1],
        "similarity": float(similarity[inlying].mean()) if len(similarity) == len(inlying) and inlying.any() else 0.0,
        "crop_px": query.crop.mask.shape[-1] / zoom,
        "mask_share": float(query.crop.mask.float().mean()),
    }


def _compare_silhouettes(best: Hypothesis, query: Query, extent: Extent) -> dict[str, float]:
    """Fit of the rerendered silhouette to the query's mask, and how far the pose moved after the rerender."""
    view, first = best.rerendered, best.first
    if view is None or first is None or first.solution is None or best.solution is None:
        return {}
    silhouette, mask = view.crop.mask, query.crop.mask
    common = _count(silhouette & mask)
    return {
        "overlap": common / max(_count(silhouette | mask), 1),
        "explained": common / max(_count(mask), 1),
        "visible": common / max(_count(silhouette), 1),
        "moved": min(extent.distance(first.solution.T_cam_obj, best.solution.T_cam_obj), 10.0),
    }


def _count(mask: Bool[Tensor, "S S"]) -> int:
    return int(mask.sum())
