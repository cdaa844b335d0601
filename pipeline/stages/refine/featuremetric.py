"""pose, fused pair, template's object points -> the pose under which the query shows the template's descriptors."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from jaxtyping import Float, Float32
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
from pipeline.items.features import FusedPair
from pipeline.spec import NonNegative, NonNegativeFloat, Positive, PositiveFloat, Spec, spec

ALPHA = {"barron": -5.0, "cauchy": 0.0, "geman_mcclure": -2.0}
MIN_POINTS = 6


@spec
class Featuremetric(Spec):
    """Featuremetric refinement of FoundPose (Örnek et al., ECCV 2024).

    Least mean, over the template's foreground cells i, of rho(|d_i - F(x_i)|^2): d_i the cell's descriptor, x_i where
    its object point lands in the query under the pose, F the query's fused map, bilinear. Levenberg-Marquardt with
    analytic Jacobians, ``iterations`` at most on each of ``sigmas_cells``: Gaussian blurs, coarse to fine, that widen
    the basin. ``loss``: Barron's with alpha -5, Cauchy's, Geman-McClure's; its scale is ``scale`` times the median
    residual at the start of each level. ``normalise``: descriptors have unit length before any blur. Of more than
    ``max_points`` cells, that many are drawn with ``seed``.

    Departures: the blurs; the maps are blurred and continued over silhouettes by their foreground alone; a cell that
    leaves the query's mask costs what its distance to a mean foreground cell costs. The pose given comes back unless
    the unblurred (the last level's) mean cost falls.
    """

    kind: ClassVar[str] = "refine.featuremetric"
    version: ClassVar[int] = 1

    loss: Literal["barron", "cauchy", "geman_mcclure"] = "geman_mcclure"
    scale: PositiveFloat = 1.0
    sigmas_cells: Annotated[tuple[NonNegativeFloat, ...], Field(min_length=1)] = (2.0, 1.0, 0.0)
    iterations: Positive = 30
    normalise: bool = True
    max_points: Positive = 1000
    seed: NonNegative = 0

    def __call__(
        self,
        T_cam_obj: Float[np.ndarray, "4 4"],
        pair: FusedPair,
        points_obj: Float[np.ndarray, "m 3"],
        K_crop: Float[np.ndarray, "3 3"],
        *,
        crop_size: int,
    ) -> Float[np.ndarray, "4 4"]:
        """T_cam_obj (mm) of lower cost, or the one given: also where fewer than 6 cells have a point."""
        query, template = self._descriptors(pair.query), self._descriptors(pair.template)
        query_mask, template_mask = pair.query_mask.cpu().numpy(), pair.template_mask.cpu().numpy()
        chosen = self._chosen(points_obj)
        if len(chosen) < MIN_POINTS or not query_mask.any():
            return T_cam_obj
        cell, points = np.flatnonzero(template_mask)[chosen], points_obj[chosen]
        K_cell = cell_affine(size=crop_size, cells=query_mask.shape[-1]) @ K_crop
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

    def _descriptors(self, features: Float[Tensor, "d h w"]) -> Float32[np.ndarray, "h w d"]:
        maps = np.ascontiguousarray(features.float().movedim(0, -1).cpu().numpy())
        return l2_normalize(maps) if self.normalise else maps

    def _chosen(self, points_obj: Float[np.ndarray, "m 3"]) -> np.ndarray:
        """Rows with a point, in order; no more than ``max_points``."""
        rows = np.flatnonzero(np.isfinite(points_obj).all(1))
        if len(rows) <= self.max_points:
            return rows
        return np.sort(np.random.default_rng(self.seed).choice(rows, self.max_points, replace=False))
