"""hypothesis -> how much the query looks like the template where the pose puts it, and how much of it that explains."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from jaxtyping import Float

from pipeline.functional.agreement import agreement
from pipeline.functional.camera import cell_affine
from pipeline.items.features import FusedPair
from pipeline.spec import NonNegativeFloat, Spec, spec


@spec
class Agreement(Spec):
    """Mean cosine times coverage times inliers to the power of ``inlier_power``.

    The template's cells are put where the pose has them: the mean cosine is that of their descriptors with the query's
    there, coverage the share of the query's foreground they reach (functional.agreement). Many inliers of a wrong
    template may agree on a pose that explains a part of the object; few cosines do.
    """

    kind: ClassVar[str] = "choose.agreement"
    version: ClassVar[int] = 1

    inlier_power: NonNegativeFloat = 0.5

    def __call__(
        self,
        T_cam_obj: Float[np.ndarray, "4 4"],
        inliers: int,
        pair: FusedPair,
        points_obj: Float[np.ndarray, "m 3"],
        K_crop: Float[np.ndarray, "3 3"],
        *,
        crop_size: int,
    ) -> float:
        """The product; 0 where the template lands outside the query's foreground."""
        K_cell = cell_affine(size=crop_size, cells=pair.query_mask.shape[-1]) @ K_crop
        cosine, coverage = agreement(
            pair.query, pair.template, pair.query_mask, pair.template_mask, points_obj, K_cell, T_cam_obj
        )
        return max(cosine, 0.0) * coverage * inliers**self.inlier_power
