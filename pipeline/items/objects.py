"""The object: its mesh and its symmetries."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int, UInt8


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh in millimetres, with one of: a texture, vertex colours, or neither (rendered grey).

    ``uv`` has its origin at the lower left of ``texture``, as ply, obj and trimesh have it; ``texture`` rows go down.
    ``digest`` is the sha256 of all bytes the mesh was read from (mesh, material and texture files).
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    colours: UInt8[np.ndarray, "v 3"] | None = None
    uv: Float[np.ndarray, "v 2"] | None = None
    texture: UInt8[np.ndarray, "H W 3"] | None = None
    digest: str = ""


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """An object a pose is asked of.

    ``symmetries`` are rigid transforms T_obj_obj (s 4 4, mm), the identity first, continuous ones discretised.
    """

    obj_id: int
    mesh: Mesh
    diameter_mm: float
    symmetries: Float[np.ndarray, "s 4 4"] = field(default_factory=lambda: np.eye(4)[None])
