"""mesh -> templates."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from jaxtyping import Float, Float32, UInt8

from pipeline.items.objects import Mesh
from pipeline.spec import Spec


class Renderer(Spec, ABC):
    """Contract of a render variant: the cameras of an object's templates, and their images.

    rgb is black where depth is 0. Depth is in float32 mm along the optical axis. Pixel centres are integers.
    """

    def count_views(self) -> int | None:
        """Number of templates of every object; None where it depends on the mesh."""
        return None

    @abstractmethod
    def cameras(self, mesh: Mesh) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "n 4 4"], tuple[int, int]]:
        """K, T_cam_obj of all templates, and the image size (h, w); every camera sees the whole mesh."""

    @abstractmethod
    def render(
        self, mesh: Mesh, K: Float[np.ndarray, "3 3"], T_cam_obj: Float[np.ndarray, "n 4 4"], size_hw: tuple[int, int]
    ) -> tuple[UInt8[np.ndarray, "n H W 3"], Float32[np.ndarray, "n H W"]]:
        """Colour and depth of the given views. Raises BadInput where the renderer is not available."""
