"""a solved hypothesis -> its worth; of a detection's hypotheses the worthiest is refined and answers."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from jaxtyping import Float

from pipeline.items.features import FusedPair
from pipeline.spec import Variant


class Chooser(Variant, Protocol):
    """What a choose variant is.

    ``points_obj`` and ``K_crop`` are those of stages.refine: object points (mm) at the centres of the template's
    foreground cells, NaN off the object, and camera frame to crop pixels, ``crop_size`` of them a side.
    """

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
        """Worth of a pose, at least 0. Nothing here sees ground truth. Never raises NoPose."""
        ...
