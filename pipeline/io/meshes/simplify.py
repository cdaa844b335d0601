"""Mesh -> a mesh of fewer faces (Garland and Heckbert, SIGGRAPH 1997), with its colours in a new texture."""

from __future__ import annotations

from dataclasses import replace
from importlib.metadata import version

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.functional.arrays import rank_rows
from pipeline.functional.surface import spread_points, surface_distance
from pipeline.io.meshes.bake import bake_texture
from pipeline.items.objects import Mesh

SIMPLIFY_VERSION = f"2, fast-simplification {version('fast-simplification')}"
_MEASURED = 100_000  # points per surface at which the distance to the other one is measured
_WELD = 1e-7  # share of the mesh's largest side: closer vertices are merged, or seams would tear open


def simplify_mesh(mesh: Mesh, faces: int, diameter_mm: float) -> tuple[Mesh, str]:
    """A mesh of about ``faces`` faces at most, and a line that says what was lost.

    Edges are collapsed regardless of colours; texture or vertex colours are then baked into a new texture.
    """
    vertices, few = _collapse(mesh, faces)
    result = Mesh(vertices, few, digest=mesh.digest, warnings=mesh.warnings)
    distance = _measure_distance(mesh, result)
    note = f"simplified from {len(mesh.faces)} to {len(few)} faces (dataset.simplify={faces}), which moves its surface"
    note += f" by up to {distance:.2g} mm, {distance / diameter_mm:.2%} of the diameter"
    if mesh.texture is None and mesh.colours is None:
        return result, note
    result = bake_texture(mesh, result)
    assert result.texture is not None
    height, width = result.texture.shape[:2]
    what = "texture" if mesh.texture is not None else "colours"
    return result, f"{note}; its {what} became a texture of {width} x {height}"


def _collapse(mesh: Mesh, faces: int) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Vertices and faces after collapsing edges until at most ``faces`` are left or no edge can be collapsed."""
    import fast_simplification

    grid = np.rint(mesh.vertices / (_WELD * np.ptp(mesh.vertices, axis=0).max()))
    _, first, index = np.unique(rank_rows(list(grid.T)), return_index=True, return_inverse=True)
    welded = index.reshape(-1)[mesh.faces]
    degenerate = (welded == np.roll(welded, 1, axis=1)).any(axis=1)
    welded = np.ascontiguousarray(welded[~degenerate], dtype=np.int32)
    if len(welded) <= faces:
        return mesh.vertices[first], welded.astype(np.int64)
    for keep_border in (True, False):  # otherwise, corners of open sheets wear off
        vertices, few = fast_simplification.simplify(
            mesh.vertices[first], welded, target_count=faces, preserve_border=keep_border
        )
        if len(few) <= faces:
            break
    return vertices, few.astype(np.int64)


def _measure_distance(first: Mesh, second: Mesh) -> float:
    """Largest distance between two surfaces, in both directions, as Metro samples it (Cignoni et al., CGF 1998)."""
    on_first, on_second = (spread_points(m.vertices, m.faces, _MEASURED) for m in (first, second))
    used = np.unique(first.faces)
    corners = first.vertices[used[:: max(1, len(used) // _MEASURED)]]
    points = np.concatenate([on_first.interpolate(first.vertices, first.faces), corners])
    there = surface_distance(points, second.vertices, second.faces, on_second)
    points = np.concatenate([on_second.interpolate(second.vertices, second.faces), second.vertices[:_MEASURED]])
    return max(there, surface_distance(points, first.vertices, first.faces, on_first))


def thin_mesh(mesh: Mesh, faces: int, *, texture_px: int) -> Mesh:
    """A quick preview: about ``faces`` faces at most, and a texture of at most ``texture_px`` a side.

    If faces are removed, vertex colours replace the texture. The geometry is too coarse for estimating poses.
    """
    if len(mesh.faces) <= faces:
        return mesh if mesh.texture is None else replace(mesh, texture=_shrink(mesh.texture, texture_px))
    from scipy.spatial import cKDTree

    vertices, few = _collapse(mesh, faces)
    colours = mesh.colours
    if mesh.texture is not None and mesh.uv is not None:
        (h, w), uv = mesh.texture.shape[:2], mesh.uv % 1.0
        rows, columns = np.rint((1 - uv[:, 1]) * (h - 1)), np.rint(uv[:, 0] * (w - 1))
        colours = mesh.texture[rows.astype(int), columns.astype(int)]
    if colours is not None:
        colours = colours[cKDTree(mesh.vertices).query(vertices)[1]]
    return Mesh(vertices, few, colours=colours)


def _shrink(texture: UInt8[np.ndarray, "H W 3"], texture_px: int) -> UInt8[np.ndarray, "h w 3"]:
    scale = texture_px / max(texture.shape[:2])
    if scale >= 1:
        return texture
    size = max(1, round(texture.shape[1] * scale)), max(1, round(texture.shape[0] * scale))
    return np.asarray(cv2.resize(texture, size, interpolation=cv2.INTER_AREA))
