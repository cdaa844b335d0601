"""Polygons -> triangles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

_FLAT = 1e-6  # share of a polygon's area: smaller flipped triangles are rounding errors


@dataclass(frozen=True)
class Ragged:
    """Lists of different lengths, one after the other."""

    counts: Int[np.ndarray, " n"]
    values: np.ndarray

    @property
    def starts(self) -> Int[np.ndarray, " n"]:
        """Index of each list's first value."""
        return np.cumsum(self.counts) - self.counts


def triangulate(vertices: Float[np.ndarray, "v 3"], polygons: Ragged) -> tuple[Int[np.ndarray, "f 3"], bool]:
    """Triangles as indices into ``polygons.values``: first those of triangles, then of quads, then of larger polygons.

    Polygons are split into fans around their first corner; if a fan would leave a concave polygon, its ears are clipped
    instead, and the second value is True. Lists of fewer than three values are dropped.
    """
    starts, triangles, cut = polygons.starts, [np.zeros((0, 3), np.int64)], False
    for count in np.unique(polygons.counts[polygons.counts >= 3]).tolist():
        corners = starts[polygons.counts == count][:, None] + np.arange(count)
        if count == 3:
            triangles.append(corners)
            continue
        indices = polygons.values[corners]
        if indices.min() < 0 or indices.max() >= len(vertices):
            return corners[:, :3], cut  # refused by check_indices
        concave = _fan_fails(vertices, indices)
        cut |= bool(concave.any())
        if count == 4:
            # of a concave quad's two diagonals, the other one lies inside
            corners = np.where(concave[:, None], np.roll(corners, -1, axis=1), corners)
            triangles += [corners[:, [0, 1, 2]], corners[:, [2, 3, 0]]]
            continue
        fan = np.stack([np.zeros(count - 2, int), np.arange(1, count - 1), np.arange(2, count)], axis=-1)
        triangles.append(corners[~concave][:, fan].reshape(-1, 3))
        triangles += [corner[_cut_ears(vertices[polygons.values[corner]])] for corner in corners[concave]]
    return np.concatenate(triangles), cut


def _fan_fails(vertices: Float[np.ndarray, "v 3"], indices: Int[np.ndarray, "n k"]) -> Bool[np.ndarray, " n"]:
    """Whether a triangle of the fan around the first corner is flipped."""
    fails = np.zeros(len(indices), dtype=bool)
    rows = max(1, (1 << 20) // indices.shape[1])
    for row in range(0, len(indices), rows):
        corners = vertices[indices[row : row + rows]]
        edges = corners[:, 1:] - corners[:, :1]
        normals = np.cross(edges[:, :-1], edges[:, 1:])
        whole = normals.sum(axis=1, keepdims=True)
        fails[row : row + rows] = ((normals * whole).sum(-1) < -_FLAT * (whole**2).sum(-1)).any(axis=1)
    return fails


def _cut_ears(corners: Float[np.ndarray, "k 3"]) -> Int[np.ndarray, "f 3"]:
    """Triangles of one polygon, projected along the axis that its normal is closest to."""
    import mapbox_earcut

    edges = corners[1:] - corners[0]
    normal = np.cross(edges[:-1], edges[1:]).sum(axis=0)
    axis = int(np.abs(normal).argmax())
    flat = np.ascontiguousarray(np.delete(corners, axis, axis=1))
    triangles = mapbox_earcut.triangulate_float64(flat, np.array([len(flat)], np.uint32)).reshape(-1, 3).astype(int)
    a, b, c = (corners[triangles[:, k]] for k in range(3))
    turned = (np.cross(b - a, c - a) @ normal) < 0
    return np.where(turned[:, None], triangles[:, ::-1], triangles)
