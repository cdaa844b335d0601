"""Objects: meshes, diameters and symmetries."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int, UInt8


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh in millimetres with a texture, vertex colours, or neither (rendered grey).

    ``uv`` has its origin at the lower left of ``texture``, as in ply, obj and trimesh; rows of ``texture`` go from top
    to bottom. ``digest``: sha256 of all files the mesh was read from (mesh, materials and textures). ``warnings``: what
    its file states that is not in the mesh, one line each.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    colours: UInt8[np.ndarray, "v 3"] | None = None
    uv: Float[np.ndarray, "v 2"] | None = None
    texture: UInt8[np.ndarray, "H W 3"] | None = None
    digest: str = ""
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """An object whose pose can be estimated.

    ``symmetries``: rigid transforms T_obj_obj (s 4 4, mm), the identity first, continuous symmetries discretised.
    """

    obj_id: int
    mesh: Mesh
    diameter_mm: float
    symmetries: Float[np.ndarray, "s 4 4"] = field(default_factory=lambda: np.eye(4)[None])
    facts: MeshFacts = field(default_factory=lambda: MeshFacts(0.0, 0.0, 0))


@dataclass(frozen=True)
class MeshFacts:
    """What warnings say of a mesh. Stored with its templates, so that a run that reads no mesh says the same.

    ``diameter_mm``: measured; ``diagonal_mm``: of its bounding box; ``faces``: that are rendered. ``warnings``: what
    its file states that is not in the mesh, missing colours, and what was simplified.
    """

    diameter_mm: float
    diagonal_mm: float
    faces: int
    warnings: tuple[str, ...] = ()
