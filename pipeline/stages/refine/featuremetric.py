"""pose, fused pair -> the pose under which the query's descriptors match the template's best."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from pydantic import Field
from torch import Tensor

from pipeline.functional.camera import cell_affine
from pipeline.functional.featuremetric import (
    RobustLoss,
    build_level,
    descend,
    l2_normalize,
    normal_equations,
    robust_scale,
)
from pipeline.items.features import PairGeometry
from pipeline.spec import NonNegative, NonNegativeFloat, Positive, PositiveFloat, spec
from pipeline.stages.refine import Refiner

ALPHA = {"barron": -5.0, "cauchy": 0.0, "geman_mcclure": -2.0}
MIN_POINTS = 6


@spec
class Featuremetric(Refiner):
    """Featuremetric refinement of FoundPose (Örnek et al., ECCV 2024).

    Minimises the mean of rho(|d_i - F(x_i)|^2) over the template's foreground cells i: d_i is the cell's descriptor,
    x_i the projection of its object point into the query, F the query's fused map (bilinear). Levenberg-Marquardt with
    analytic Jacobians, at most ``iterations`` per level of ``sigmas_cells``: Gaussian blurs, coarse to fine, that widen
    the basin of convergence. ``loss``: Barron with alpha -5, Cauchy, or Geman-McClure; its scale is ``scale`` times
    the median residual at the start of each level. ``normalise``: descriptors have unit length before blurring.
    ``max_points``: larger sets of cells are sampled with ``seed``.

    Departures from the paper: the blurs; maps are blurred and extrapolated across silhouettes from the foreground
    only; a cell outside the query's mask costs its distance to a mean foreground cell. The input pose is returned
    unless the mean cost of the last level falls.
    """

    kind: ClassVar[str] = "refine.featuremetric"
    version: ClassVar[int] = 1

    loss: Literal["barron", "cauchy", "geman_mcclure"] = "geman_mcclure"
    scale: PositiveFloat = 1.0
    sigmas_cells: Annotated[tuple[NonNegativeFloat, ...], Field(min_length=1)] = (1.0, 0.0)
    iterations: Positive = 30
    normalise: bool = True
    max_points: Positive = 500
    seed: NonNegative = 0

    def __call__(self, T_cam_obj: Float[np.ndarray, "4 4"], geometry: PairGeometry) -> Float[np.ndarray, "4 4"]:
        """A pose (mm) of lower cost, or the one given; the latter also where fewer than 6 cells have a point."""
        pair, rows = geometry.pair, self._choose_rows(geometry.points_obj)
        if len(rows) < MIN_POINTS or not pair.query_mask.any():
            return T_cam_obj
        K_cell = cell_affine(size=geometry.crop_size, cells=pair.query_mask.shape[-1]) @ geometry.K_crop
        query, query_mask, first_xy = self._cut_foreground(pair.query, pair.query_mask)
        template, template_mask, _ = self._cut_foreground(pair.template, pair.template_mask)
        cell, points = np.flatnonzero(template_mask)[rows], geometry.points_obj[rows]
        K_cell[:2] -= first_xy[:, None] * K_cell[2]
        T = T_cam_obj
        for sigma in self.sigmas_cells:
            surface, field = build_level(
                query,
                query_mask,
                template,
                template_mask,
                cell,
                points,
                sigma_cells=sigma,
                normalize=self.normalise,
            )
            robust = RobustLoss(ALPHA[self.loss], self.scale * robust_scale(surface, field, K_cell, T))
            T = descend(surface, field, K_cell, T, robust, iterations=self.iterations)
        robust = RobustLoss(ALPHA[self.loss], self.scale * robust_scale(surface, field, K_cell, T_cam_obj))
        before, after = (normal_equations(surface, field, K_cell, pose, robust)[0] for pose in (T_cam_obj, T))
        return T if after < before else T_cam_obj

    def _cut_foreground(
        self, features: Float[Tensor, "d h w"], mask: Bool[Tensor, "h w"]
    ) -> tuple[Float32[np.ndarray, "y x d"], Bool[np.ndarray, "y x"], Int[np.ndarray, " 2"]]:
        """Descriptors and mask of the foreground's bounding box with a cell around it, and its first cell (x, y).

        What lies farther from the foreground is never sampled.
        """
        inside = mask.cpu().numpy()
        (top, bottom), (left, right) = (np.flatnonzero(inside.any(axis))[[0, -1]] for axis in (1, 0))
        part = np.s_[max(top - 1, 0) : bottom + 2, max(left - 1, 0) : right + 2]
        cut = features.movedim(0, -1)[part].float().cpu().numpy()
        descriptors = l2_normalize(cut) if self.normalise else np.ascontiguousarray(cut)
        return descriptors, inside[part], np.array([max(left - 1, 0), max(top - 1, 0)])

    def _choose_rows(self, points_obj: Float[np.ndarray, "m 3"]) -> np.ndarray:
        """Rows with a point, in order; at most ``max_points``."""
        rows = np.flatnonzero(np.isfinite(points_obj).all(1))
        if len(rows) <= self.max_points:
            return rows
        return np.sort(np.random.default_rng(self.seed).choice(rows, self.max_points, replace=False))
