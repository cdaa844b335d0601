"""Checks that a mesh can be rendered and measured."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.errors import BadInput
from pipeline.items.objects import Mesh


def check_mesh(path: Path, mesh: Mesh) -> None:
    """Raise BadInput for a mesh without faces or extent, or with an index or number that cannot be used."""
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
