"""Mesh -> diameter."""

from __future__ import annotations

import numpy as np

from pipeline.functional.diameter import point_diameter
from pipeline.items.objects import Mesh


def diameter_mm(mesh: Mesh) -> float:
    """Largest distance between two vertices of faces, mm. Unused vertices, which scans may have, do not count."""
    used = np.zeros(len(mesh.vertices), dtype=bool)
    used[mesh.faces] = True
    return point_diameter(mesh.vertices[used])
