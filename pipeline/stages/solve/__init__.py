"""object points, image points, K -> pose."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from jaxtyping import Float

from pipeline.items.poses import PoseSolution


class Solver(Protocol):
    """What a solve variant is."""

    def __call__(
        self,
        points_obj: Float[np.ndarray, "m 3"],
        px_img: Float[np.ndarray, "m 2"],
        K: Float[np.ndarray, "3 3"],
    ) -> PoseSolution:
        """T_cam_obj (mm) from full-image pixels. Raises NoPose when no pose is supported by enough inliers."""
        ...
