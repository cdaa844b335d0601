"""Stray faces of a scan, far from the object: they enlarge the diameter, and with it the distance of templates."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from pipeline.functional.surface import face_areas
from pipeline.items.objects import Mesh

_SHARE = 0.003  # share of the surface that may be stray, at either end of each axis
_ENLARGED = 1.25  # minimum ratio of the bounding box's diagonals with and without stray faces
_MARGIN = 0.1  # share of that diagonal: faces closer to most of the surface are not stray
_BINS = 4096


def describe_stray_faces(mesh: Mesh) -> tuple[str, ...]:
    """A warning if a small part of the surface is so far from the rest that it enlarges the mesh by a quarter."""
    areas = face_areas(mesh.vertices, mesh.faces)
    if not areas.sum() > 0:
        return ()
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    core = np.logical_and.reduce([_in_core(centres[:, axis], areas) for axis in range(3)])
    if core.all() or not core.any():
        return ()
    points = mesh.vertices[mesh.faces[core].reshape(-1)]
    low, high, margin = points.min(axis=0), points.max(axis=0), _MARGIN * _diagonal(points)
    stray = ((centres < low - margin) | (centres > high + margin)).any(axis=1)
    whole, rest = (_diagonal(mesh.vertices[faces.reshape(-1)]) for faces in (mesh.faces, mesh.faces[~stray]))
    if whole <= _ENLARGED * rest:
        return ()
    count, share = int(stray.sum()), areas[stray].sum() / areas.sum()
    them = "1 face" if count == 1 else f"{count} faces"
    return (f"{them}, {share:.2g} of its surface, enlarge it from {rest:.3g} to {whole:.3g} mm: remove stray parts",)


def _in_core(places: Float[np.ndarray, " f"], areas: Float[np.ndarray, " f"]) -> Bool[np.ndarray, " f"]:
    """Whether faces lie between those ends of an axis that hold less than the stray share of the surface."""
    total, edges = np.histogram(places, bins=_BINS, weights=areas)
    below = np.cumsum(total) / total.sum()
    first, last = np.searchsorted(below, [_SHARE, 1 - _SHARE])
    return (places >= edges[first]) & (places <= edges[min(last + 1, _BINS)])


def _diagonal(points: Float[np.ndarray, "n 3"]) -> float:
    return float(np.linalg.norm(np.ptp(points, axis=0)))
