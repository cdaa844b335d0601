"""mesh -> templates."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from jaxtyping import Float, Float32, UInt8

from pipeline.items.objects import Mesh
from pipeline.spec import Variant


class Renderer(Variant, Protocol):
    """What a render variant is: a spec that knows its cameras and draws them.

    rgb is black where depth is 0; depth is float32 mm along the optical axis; pixel centres are integers.
    """

    def cameras(self, mesh: Mesh) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "n 4 4"], tuple[int, int]]:
        """K, the T_cam_obj of all templates, and the image size (h, w); every camera sees the whole mesh."""
        ...

    def render(
        self, mesh: Mesh, K: Float[np.ndarray, "3 3"], T_cam_obj: Float[np.ndarray, "n 4 4"], size_hw: tuple[int, int]
    ) -> tuple[UInt8[np.ndarray, "n H W 3"], Float32[np.ndarray, "n H W"]]:
        """Colour and depth of the given views. Raises BadInput when this machine cannot run the renderer."""
        ...
