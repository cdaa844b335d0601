"""hypothesis -> how many correspondences agree on its pose."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from jaxtyping import Float

from pipeline.items.features import FusedPair
from pipeline.spec import Spec, spec


@spec
class Inliers(Spec):
    """Most inliers win (FoundPose, Örnek et al., ECCV 2024)."""

    kind: ClassVar[str] = "choose.inliers"
    version: ClassVar[int] = 1

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
        """The number of inliers."""
        return float(inliers)
