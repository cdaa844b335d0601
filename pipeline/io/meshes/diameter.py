"""Mesh -> diameter."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from pipeline.items.objects import Mesh

_BLOCK_ROWS = (
    512  # points compared with all others at a time: on a sphere none is ruled out, and all pairs would not fit
)


def diameter_mm(mesh: Mesh) -> float:
    """Largest distance between two vertices, mm; exact, since both lie on the convex hull."""
    from scipy.spatial import ConvexHull, QhullError
    from scipy.spatial.distance import cdist

    points = np.unique(mesh.vertices, axis=0)
    with suppress(QhullError):  # a flat mesh has no 3D hull: compare all pairs
        points = points[ConvexHull(points).vertices]
    radius = np.linalg.norm(points - (points.min(axis=0) + points.max(axis=0)) / 2, axis=-1)
    largest = float(cdist(points[[radius.argmax()]], points).max())
    # by the triangle inequality, both ends of a longer distance lie at least this far from the centre
    points = points[radius >= (largest - radius.max()) * (1 - 1e-9)]
    for row in range(0, len(points), _BLOCK_ROWS):
        largest = max(largest, float(cdist(points[row : row + _BLOCK_ROWS], points).max()))
    return largest
