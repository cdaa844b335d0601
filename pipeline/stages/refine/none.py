"""pose -> the same pose."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from jaxtyping import Float

from pipeline.items.features import FusedPair
from pipeline.spec import Spec, spec


@spec
class NoRefinement(Spec):
    """The solver has the last word, as in the paper."""

    kind: ClassVar[str] = "refine.none"
    version: ClassVar[int] = 1

    def __call__(
        self,
        T_cam_obj: Float[np.ndarray, "4 4"],
        pair: FusedPair,
        points_obj: Float[np.ndarray, "m 3"],
        K_crop: Float[np.ndarray, "3 3"],
        *,
        crop_size: int,
    ) -> Float[np.ndarray, "4 4"]:
        """The very pose given."""
        return T_cam_obj
