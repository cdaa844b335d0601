"""Triangle surfaces: points on them, and distances to them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

_NEAR = 8  # faces that a point's distance is computed to
_CHUNK = 1 << 15  # points at a time: 260,000 pairs of a point and a face


@dataclass(frozen=True)
class SurfacePoints:
    """Points on faces: index of the face and barycentric weights."""

    face: Int[np.ndarray, " n"]
    weight: Float[np.ndarray, "n 3"]

    def interpolate(self, values: Float[np.ndarray, "v k"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "n k"]:
        """Values at the points, from values at vertices."""
        corners = faces[self.face]
        parts = (values[corners[:, k]] * self.weight[:, k, None] for k in range(3))
        return np.sum(list(parts), axis=0)


def face_areas(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, " f"]:
    """Areas, in the square of the vertices' unit."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=-1) / 2


def spread_points(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], count: int, *, seed: int = 0
) -> SurfacePoints:
    """``count`` points spread evenly over the surface: equal areas get equal numbers of points, up to one."""
    total = np.cumsum(face_areas(vertices, faces))
    face = np.searchsorted(total, (np.arange(count) + 0.5) / count * total[-1])
    u, v = np.random.default_rng(seed).random((2, count))
    outside = u + v > 1
    u, v = np.where(outside, 1 - u, u), np.where(outside, 1 - v, v)
    return SurfacePoints(np.minimum(face, len(faces) - 1), np.stack([1 - u - v, u, v], axis=-1))


def surface_distance(
    points: Float[np.ndarray, "n 3"],
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    on_surface: SurfacePoints,
) -> float:
    """Largest distance from the points to the surface, in their unit; never too small.

    The distance is computed to the faces of the nearest of ``on_surface`` and of the faces' centres. A face
    that is closer, but has none of them nearby, would make the result too large.
    """
    from scipy.spatial import cKDTree

    centres = np.sum([vertices[faces[:, k]] for k in range(3)], axis=0) / 3
    tree = cKDTree(np.concatenate([centres, on_surface.interpolate(vertices, faces)]), balanced_tree=False)
    owner = np.concatenate([np.arange(len(faces)), on_surface.face])
    longest = 0.0
    for row in range(0, len(points), _CHUNK):
        chunk = points[row : row + _CHUNK]
        near = owner[tree.query(chunk, k=min(_NEAR, len(owner)))[1]]
        a, b, c = (vertices[faces[near, k]] for k in range(3))
        longest = max(longest, float(_distance_to_triangles(chunk[:, None], a, b, c).min(axis=1).max()))
    return longest


def _distance_to_triangles(
    p: Float[np.ndarray, "n 1 3"],
    a: Float[np.ndarray, "n k 3"],
    b: Float[np.ndarray, "n k 3"],
    c: Float[np.ndarray, "n k 3"],
) -> Float[np.ndarray, "n k"]:
    """Distances to triangles: to the plane where the foot lies inside, else to the nearest side."""
    sides = np.minimum(_distance_to_segments(p, a, b), _distance_to_segments(p, b, c))
    sides = np.minimum(sides, _distance_to_segments(p, c, a))
    normal = np.cross(b - a, c - a)
    inside = np.ones(sides.shape, dtype=bool)
    for start, end in ((a, b), (b, c), (c, a)):
        inside &= (np.cross(end - start, p - start) * normal).sum(axis=-1) >= 0
    length = np.linalg.norm(normal, axis=-1)
    height = np.abs(((p - a) * normal).sum(axis=-1)) / np.maximum(length, 1e-30)
    return np.where(inside & (length > 0), height, sides)


def _distance_to_segments(
    p: Float[np.ndarray, "n 1 3"], start: Float[np.ndarray, "n k 3"], end: Float[np.ndarray, "n k 3"]
) -> Float[np.ndarray, "n k"]:
    along = end - start
    square = np.maximum((along**2).sum(axis=-1), 1e-300)
    t = np.clip(((p - start) * along).sum(axis=-1) / square, 0, 1)
    return np.linalg.norm(p - start - t[..., None] * along, axis=-1)


def signed_volume(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> float:
    """Volume inside a closed surface; negative where its faces are turned inside out. Holes change it little."""
    a, b, c = np.moveaxis((vertices - vertices.mean(axis=0))[faces], 1, 0)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)
