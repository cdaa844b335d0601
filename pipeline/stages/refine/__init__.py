"""pose, fused pair, template's object points -> pose."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from jaxtyping import Float

from pipeline.items.features import FusedPair
from pipeline.spec import Variant


class Refiner(Variant, Protocol):
    """What a refine variant is.

    ``points_obj``: object points (mm) at the centres of the template's foreground cells, in reading order, NaN off the
    object. ``K_crop`` = A_crop_img K of the query: camera frame to crop pixels, ``crop_size`` of them a side.
    """

    def __call__(
        self,
        T_cam_obj: Float[np.ndarray, "4 4"],
        pair: FusedPair,
        points_obj: Float[np.ndarray, "m 3"],
        K_crop: Float[np.ndarray, "3 3"],
        *,
        crop_size: int,
    ) -> Float[np.ndarray, "4 4"]:
        """T_cam_obj (mm): a better one, or the one given. Never raises NoPose."""
        ...
