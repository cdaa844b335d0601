"""mesh -> templates, with the first renderer that is available on this machine."""

from __future__ import annotations

from dataclasses import fields
from importlib.util import find_spec
from typing import ClassVar

import numpy as np
from jaxtyping import Float, Float32, UInt8

from pipeline.items.objects import Mesh
from pipeline.spec import spec
from pipeline.stages.render.cameras import RenderSpec
from pipeline.stages.render.pyrender import Pyrender
from pipeline.stages.render.raycast import Raycast


@spec
class Auto(RenderSpec):
    """The ray caster if embreex can be imported, else pyrender. Templates are cached under the resolved renderer."""

    kind: ClassVar[str] = "render.auto"
    version: ClassVar[int] = 1

    def resolve(self) -> Raycast | Pyrender:
        """The renderer that is used, with the same fields."""
        chosen = Raycast if _is_importable("embreex") else Pyrender
        return chosen(**{field.name: getattr(self, field.name) for field in fields(self)})

    def render(
        self, mesh: Mesh, K: Float[np.ndarray, "3 3"], T_cam_obj: Float[np.ndarray, "n 4 4"], size_hw: tuple[int, int]
    ) -> tuple[UInt8[np.ndarray, "n H W 3"], Float32[np.ndarray, "n H W"]]:
        """As Renderer.render, by the resolved renderer."""
        return self.resolve().render(mesh, K, T_cam_obj, size_hw)


def _is_importable(package: str) -> bool:
    if find_spec(package) is None:
        return False
    try:
        __import__(f"{package}.rtcore_scene")
    except ImportError:  # built for another processor or C library
        return False
    return True
