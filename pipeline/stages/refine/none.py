"""pose -> the same pose."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from jaxtyping import Float

from pipeline.items.features import PairGeometry
from pipeline.spec import spec
from pipeline.stages.refine import Refiner


@spec
class NoRefinement(Refiner):
    """The solver's pose is final, as in the paper."""

    kind: ClassVar[str] = "refine.none"
    version: ClassVar[int] = 1

    def __call__(self, T_cam_obj: Float[np.ndarray, "4 4"], geometry: PairGeometry) -> Float[np.ndarray, "4 4"]:
        """The pose given."""
        return T_cam_obj
