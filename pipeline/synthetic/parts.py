"""Building blocks of procedural objects: superquadrics, surfaces of revolution, tubes, smooth noise."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from pipeline.functional.viewpoints import icosphere_mesh

Shape = tuple[Float[np.ndarray, "_v 3"], Int[np.ndarray, "_f 3"]]
Rng = np.random.Generator


def superquadric(rng: Rng, size: Float[np.ndarray, " 3"], roundness: float | None = None, level: int = 3) -> Shape:
    """|x|^p + |y|^p + |z|^p = 1 with p = 2 / roundness, scaled: an ellipsoid at roundness 1, nearly a box at 0.2."""
    power = 2 / (rng.uniform(0.3, 1.2) if roundness is None else roundness)
    points, faces = icosphere_mesh(level)
    return points / (np.abs(points) ** power).sum(axis=-1, keepdims=True) ** (1 / power) * size, faces


def revolve(radius: Float[np.ndarray, "r s"], height: Float[np.ndarray, " r"], *, lid: int = 10) -> Shape:
    """Rings of ``s`` points around the z axis, stacked, closed at both ends by ``lid`` rings and a point."""
    shrink = (np.arange(lid) + 0.5) / lid
    radius = np.concatenate([radius[:1] * shrink[:, None], radius, radius[-1:] * shrink[::-1, None]])
    height = np.concatenate([np.repeat(height[0], lid), height, np.repeat(height[-1], lid)])
    segments = radius.shape[1]
    angle = 2 * np.pi * np.arange(segments) / segments
    rings = np.stack(
        [radius * np.cos(angle), radius * np.sin(angle), np.broadcast_to(height[:, None], radius.shape)], -1
    )
    return connect_rings(rings)


def tube(path: Float[np.ndarray, "r 3"], radius: float) -> Shape:
    """A round tube along a path in the x-z plane, closed at both ends."""
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    side = np.array([0.0, 1.0, 0.0])
    angle = 2 * np.pi * np.arange(16) / 16
    ring = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(tangent, side)[:, None]
    return connect_rings(path[:, None] + radius * ring)


def connect_rings(rings: Float[np.ndarray, "r s 3"]) -> Shape:
    """Triangles between neighbouring rings; the first and the last ring are closed by a point at their centre."""
    r, s, _ = rings.shape
    low = (np.arange(r - 1)[:, None] * s + np.arange(s)).reshape(-1)
    next_low = (np.arange(r - 1)[:, None] * s + (np.arange(s) + 1) % s).reshape(-1)
    sides = [np.stack([low, next_low, low + s], -1), np.stack([next_low, next_low + s, low + s], -1)]
    k, following = np.arange(s), (np.arange(s) + 1) % s
    top = (r - 1) * s
    caps = [
        np.stack([following, k, np.full(s, r * s)], -1),
        np.stack([top + k, top + following, np.full(s, r * s + 1)], -1),
    ]
    ends = np.stack([rings[0].mean(axis=0), rings[-1].mean(axis=0)])
    return np.concatenate([rings.reshape(-1, 3), ends]), np.concatenate(sides + caps)


def polygon_radius(corner: Float[np.ndarray, "k 2"], angle: Float[np.ndarray, " s"]) -> Float[np.ndarray, " s"]:
    """Distance from the origin to the polygon's outline in each direction; the origin must be inside."""
    a, edge = corner, np.roll(corner, -1, axis=0) - corner
    ray = np.stack([np.cos(angle), np.sin(angle)], axis=-1)[:, None]
    cross = ray[..., 0] * edge[:, 1] - ray[..., 1] * edge[:, 0]
    cross = np.where(np.abs(cross) < 1e-12, 1e-12, cross)
    distance = (a[:, 0] * edge[:, 1] - a[:, 1] * edge[:, 0]) / cross
    where = (a[:, 0] * ray[..., 1] - a[:, 1] * ray[..., 0]) / cross
    meets = (distance > 0) & (where >= -1e-9) & (where <= 1 + 1e-9)
    return np.where(meets, distance, np.inf).min(axis=1)


def merge(parts: list[Shape]) -> Shape:
    """Several shapes as one."""
    offsets = np.cumsum([0] + [len(vertices) for vertices, _ in parts[:-1]])
    faces = [part_faces + offset for (_, part_faces), offset in zip(parts, offsets, strict=True)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


def smooth_noise(
    points: Float[np.ndarray, "n 3"], rng: Rng, *, scale: float, waves: int = 24
) -> Float[np.ndarray, " n"]:
    """A smooth random function of space with about unit variance and bumps about ``scale`` wide."""
    k = rng.normal(size=(waves, 3)) / scale
    return np.sin(points @ k.T + rng.uniform(0, 2 * np.pi, waves)).sum(axis=-1) * (2 / waves) ** 0.5


def random_direction(rng: Rng) -> Float[np.ndarray, " 3"]:
    """A unit vector, uniform on the sphere."""
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def random_rotation(rng: Rng) -> Float[np.ndarray, "3 3"]:
    """Uniform on SO(3): the QR decomposition of a Gaussian matrix, signs fixed (Mezzadri, 2007)."""
    Q, R = np.linalg.qr(rng.normal(size=(3, 3)))
    Q = Q * np.sign(np.diag(R))
    return Q * np.sign(np.linalg.det(Q))
