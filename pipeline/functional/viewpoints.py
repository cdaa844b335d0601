"""Viewpoint sets: rotations R_cam_obj of the cameras from which templates are rendered."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from pipeline.functional.rigid import look_at

ViewpointSet = Literal["icosphere_upper", "icosphere", "fibonacci", "superfibonacci"]

_LEVEL = 2  # the paper's icosphere: 642 directions, 301 of them above the horizon
_GOLDEN_RATIO = (1 + 5**0.5) / 2


def viewpoint_rotations(name: ViewpointSet, n: int, inplane: int = 1) -> Float[np.ndarray, "n 3 3"]:
    """R_cam_obj of a named set, each repeated at ``inplane`` equal rotations about the optical axis.

    ``icosphere_upper``: the 301 level-2 directions with z > 0; ``icosphere``: all 642 (both ignore ``n``);
    ``fibonacci``: ``n`` directions; ``superfibonacci``: ``n`` rotations. Repeats of a view are consecutive.
    """
    if name == "superfibonacci":
        R = superfibonacci(n)
    else:
        directions = fibonacci(n) if name == "fibonacci" else icosphere(_LEVEL)
        R = look_at(directions[directions[:, 2] > 0] if name == "icosphere_upper" else directions)[:, :3, :3]
    return add_inplane_turns(R, inplane)


def add_inplane_turns(R_cam_obj: Float[np.ndarray, "n 3 3"], turns: int) -> Float[np.ndarray, "m 3 3"]:
    """Each rotation at ``turns`` equal angles about the camera's optical axis, angle 0 first; m = n * turns."""
    angle = 2 * np.pi * np.arange(turns) / turns
    c, s, zero, one = np.cos(angle), np.sin(angle), np.zeros(turns), np.ones(turns)
    R_inplane = np.stack([c, -s, zero, s, c, zero, zero, zero, one], axis=-1).reshape(-1, 3, 3)
    return (R_inplane[None] @ R_cam_obj[:, None]).reshape(-1, 3, 3)


def icosphere(level: int) -> Float[np.ndarray, "n 3"]:
    """Unit vertices of an icosahedron subdivided level + 1 times: 42, 162, 642 for levels 0, 1, 2.

    One vertex lies on +z, as in Blender's icosphere; level 2 then has 40 vertices on the horizon and 301 above it (the
    golden-rectangle orientation would have 32 and 305).
    """
    return icosphere_mesh(level)[0]


def icosphere_mesh(level: int) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Vertices and faces (wound outwards) of ``icosphere(level)``."""
    points, faces = _icosahedron()
    for _ in range(level + 1):
        points, faces = _halve_edges(points, faces)
    return points, faces


def fibonacci(n: int) -> Float[np.ndarray, "n 3"]:
    """N unit directions on a Fibonacci lattice: latitudes of equal area, longitudes a golden angle apart.

    Gonzalez, Mathematical Geosciences 2010; the first and last latitudes are half a step from the poles.
    """
    i = np.arange(n)
    z = 1 - (2 * i + 1) / n
    longitude = 2 * np.pi * i / _GOLDEN_RATIO
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(longitude), radius * np.sin(longitude), z], axis=-1)


def superfibonacci(n: int) -> Float[np.ndarray, "n 3 3"]:
    """N rotations spread evenly over SO(3) along a super-Fibonacci spiral of quaternions (Alexa, CVPR 2022, Alg. 1)."""
    phi, psi = 2**0.5, 1.533751168755204288118041  # psi: the root of x^4 = x + 4 (section 4)
    s = np.arange(n) + 0.5
    r, R = np.sqrt(s / n), np.sqrt(1 - s / n)
    alpha, beta = 2 * np.pi * s / phi, 2 * np.pi * s / psi
    return _quaternion_rotation(r * np.sin(alpha), r * np.cos(alpha), R * np.sin(beta), R * np.cos(beta))


def _quaternion_rotation(
    x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"], z: Float[np.ndarray, " n"], w: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3 3"]:
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def _icosahedron() -> tuple[Float[np.ndarray, "12 3"], Int[np.ndarray, "20 3"]]:
    """Poles on the z axis and two rings of five vertices at z = +-1/sqrt(5), the lower one rotated by 36 degrees."""
    ring = 2 * np.pi * np.arange(5) / 5
    z, radius = 1 / 5**0.5, 2 / 5**0.5
    upper = np.stack([radius * np.cos(ring), radius * np.sin(ring), np.full(5, z)], axis=-1)
    lower = np.stack([radius * np.cos(ring + np.pi / 5), radius * np.sin(ring + np.pi / 5), np.full(5, -z)], axis=-1)
    k, following = np.arange(5), (np.arange(5) + 1) % 5
    faces = np.concatenate(
        [
            np.stack([np.zeros(5, int), 1 + k, 1 + following], axis=-1),
            np.stack([1 + k, 6 + k, 1 + following], axis=-1),
            np.stack([1 + following, 6 + k, 6 + following], axis=-1),
            np.stack([np.full(5, 11), 6 + following, 6 + k], axis=-1),
        ]
    )
    return np.concatenate([[[0.0, 0.0, 1.0]], upper, lower, [[0.0, 0.0, -1.0]]]), faces


def _halve_edges(
    points: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]]:
    """Each triangle split into four; edge midpoints, projected to the unit sphere, are appended to the points."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=-1).reshape(-1, 2)
    unique, where = np.unique(edges, axis=0, return_inverse=True)
    middle = points[unique].sum(axis=1)
    middle[np.abs(middle[:, 2]) < 1e-12, 2] = 0.0  # put the horizon exactly at z = 0
    middle /= np.linalg.norm(middle, axis=-1, keepdims=True)
    ab, bc, ca = (len(points) + where.reshape(-1, 3)).T
    a, b, c = faces.T
    quarters = [np.stack(corner, axis=-1) for corner in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    return np.concatenate([points, middle]), np.concatenate(quarters)
