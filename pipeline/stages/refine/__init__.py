"""pose, fused pair with the template's object points -> refined pose."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from jaxtyping import Float

from pipeline.items.features import PairGeometry
from pipeline.spec import Spec


class Refiner(Spec, ABC):
    """Contract of a refine variant."""

    @abstractmethod
    def __call__(self, T_cam_obj: Float[np.ndarray, "4 4"], geometry: PairGeometry) -> Float[np.ndarray, "4 4"]:
        """A better T_cam_obj (mm), or the one given. Never raises NoPose."""
