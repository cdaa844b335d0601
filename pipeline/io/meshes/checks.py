"""Checks that a mesh can be rendered and measured, and that it agrees with what its file states."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.errors import BadInput
from pipeline.items.objects import Mesh

_ROUNDING = 0.01  # share of a mesh's largest side: stated bounds may be rounded, or from before compression


def check_mesh(path: Path, mesh: Mesh) -> None:
    """Raise BadInput for a mesh without faces or extent, or with an invalid index or coordinate."""
    check_indices(path, mesh)
    wrong = np.flatnonzero(~np.isfinite(mesh.vertices).all(axis=1))
    if len(wrong):
        found = f"vertex {wrong[0]} at {mesh.vertices[wrong[0]].tolist()}"
        raise BadInput(path, found=found, needed="finite coordinates in mm")
    if not np.ptp(mesh.vertices, axis=0).any():
        raise BadInput(path, found="all vertices at one point", needed="a mesh with an extent, in mm")
    check_uv(path, mesh)


def check_uv(path: Path, mesh: Mesh) -> None:
    """Raise BadInput for a texture coordinate that is NaN or infinite."""
    if mesh.uv is not None and not np.isfinite(mesh.uv).all():
        raise BadInput(path, found="a texture coordinate that is not a number", needed="finite coordinates")


def check_indices(path: Path, mesh: Mesh) -> None:
    """Raise BadInput for a mesh without vertices or faces, or whose faces refer to vertices it does not have."""
    if not len(mesh.vertices) or not len(mesh.faces):
        found = f"{len(mesh.vertices)} vertices and {len(mesh.faces)} faces"
        raise BadInput(path, found=found, needed="a mesh with vertices and faces")
    low, high = int(mesh.faces.min()), int(mesh.faces.max())
    if low < 0 or high >= len(mesh.vertices):
        found = f"a face with vertex {low if low < 0 else high}"
        raise BadInput(path, found=found, needed=f"indices from 0 to {len(mesh.vertices) - 1}")


def check_bounds(path: Path, vertices: Float[np.ndarray, "v 3"], stated: Float[np.ndarray, "2 3"]) -> None:
    """Raise BadInput if the bounding box of the vertices differs from the one stated (lowest, highest corner)."""
    actual = np.stack([vertices.min(axis=0), vertices.max(axis=0)])
    if not np.isfinite(vertices).all() or not np.isfinite(stated).all():
        return  # reported by check_mesh
    if np.abs(actual - stated).max() > _ROUNDING * max(np.ptp(stated, axis=0).max(), np.ptp(actual, axis=0).max()):
        found = f"vertices from {_corner(actual[0])} to {_corner(actual[1])}"
        needed = f"those from {_corner(stated[0])} to {_corner(stated[1])} that the file states; export it again"
        raise BadInput(path, found=found, needed=needed)


def check_count(path: Path, what: str, found: int, stated: int) -> None:
    """Raise BadInput if the number of elements differs from that of vertices, or from what the file states."""
    if found != stated:
        raise BadInput(path, found=f"{found} {what}", needed=f"{stated}")


def _corner(point: Float[np.ndarray, " 3"]) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in point) + ")"
