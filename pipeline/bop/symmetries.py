"""mesh -> its symmetries, and their entry in BOP's models_info.json."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.bop.models import symmetry_transforms
from pipeline.functional.shading import Mipmap, mip_levels, texel_density, texture_colour
from pipeline.functional.surface import SurfacePoints, spread_points
from pipeline.functional.symmetry import Surface, Symmetries, find_symmetries
from pipeline.io.meshes import diameter_mm
from pipeline.items.objects import Mesh

SYMMETRIES_VERSION = 1
"""Raise it when the symmetries of the same mesh change."""
_POINTS = 15_000
_FOOTPRINT = 0.01  # of the diameter: finer patterns of a texture are averaged out


def mesh_symmetries(mesh: Mesh, diameter: float | None = None) -> tuple[Symmetries, Symmetries]:
    """Symmetries of a mesh's geometry, and the subset that preserves its colours. ``diameter``: mm, if known."""
    diameter = diameter_mm(mesh) if diameter is None else diameter
    found = spread_points(mesh.vertices, mesh.faces, _POINTS)
    order = np.random.default_rng(0).permutation(_POINTS)
    shuffled = SurfacePoints(found.face[order], found.weight[order])
    points = shuffled.interpolate(mesh.vertices, mesh.faces)
    return find_symmetries(Surface(points, _surface_colours(mesh, shuffled, diameter), diameter))


def _surface_colours(mesh: Mesh, points: SurfacePoints, diameter: float) -> Float[np.ndarray, "n 3"] | None:
    """Colours of surface points, 0 to 1."""
    if mesh.texture is not None and mesh.uv is not None:
        density = texel_density(mesh.vertices, mesh.faces, mesh.uv, mesh.texture.shape[:2])
        texels = (density[points.face] * _FOOTPRINT * diameter).astype(np.float32)
        uv = points.interpolate(mesh.uv, mesh.faces).astype(np.float32)
        return np.asarray(texture_colour(Mipmap.of(mip_levels(mesh.texture)), uv, texels), float) / 255
    if mesh.colours is not None:
        return points.interpolate(mesh.colours.astype(float), mesh.faces) / 255
    return None


def transforms_of(symmetries: Symmetries) -> Float[np.ndarray, "s 4 4"]:
    """All symmetry transforms T_obj_obj (mm), the identity first, continuous ones discretised as BOP does."""
    return symmetry_transforms(symmetries.discrete, symmetries.axes, symmetries.offsets)


def info_record(mesh: Mesh, diameter: float, symmetries: Symmetries) -> dict[str, Any]:
    """The entry of models_info.json, mm: diameter, bounding box and symmetries."""
    low, size = mesh.vertices.min(axis=0), np.ptp(mesh.vertices, axis=0)
    record: dict[str, Any] = {"diameter": diameter}
    record |= {f"min_{axis}": float(value) for axis, value in zip("xyz", low, strict=True)}
    record |= {f"size_{axis}": float(value) for axis, value in zip("xyz", size, strict=True)}
    if len(symmetries.discrete):
        record["symmetries_discrete"] = [T.reshape(-1).tolist() for T in symmetries.discrete]
    if len(symmetries.axes):
        pairs = zip(symmetries.axes.tolist(), symmetries.offsets.tolist(), strict=True)
        record["symmetries_continuous"] = [{"axis": axis, "offset": offset} for axis, offset in pairs]
    return record
