"""Objects -> clusters of views, stored in shards on disk.

A view is stored as albedo, normals and depth instead of a picture: it can then be rendered as a template or under any
light, and the object point of every cell is known.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float16, Float32, Int8, UInt8

from pipeline.embedded.shapes import make_training_object
from pipeline.functional.camera import project, square_crop
from pipeline.functional.rigid import rigid, transform
from pipeline.items.objects import Mesh
from pipeline.stages.render.raycast import surface_points
from pipeline.synthetic.parts import Rng, random_direction, random_rotation

SIZE = 128
EMPTY_DEPTH = -100.0
RINGS_DEG = ((0, 10), (8, 20), (15, 35), (30, 60))
VIEWS = len(RINGS_DEG) + 3
"""Views per cluster: the query's, one in each ring of angles around it, a half-turn of it, and a random one."""


@dataclass(frozen=True, eq=False)
class Views:
    """Clusters of ``VIEWS`` views of objects of radius 1.

    Normals (camera frame) are multiplied by 127. Depth is relative to the object's centre; background: EMPTY_DEPTH.
    """

    albedo: UInt8[np.ndarray, "n v S S 3"]
    normal: Int8[np.ndarray, "n v S S 3"]
    depth: Float16[np.ndarray, "n v S S"]
    K: Float32[np.ndarray, "n v 3 3"]
    T: Float32[np.ndarray, "n v 4 4"]

    def __len__(self) -> int:
        return len(self.K)


_SHARD = np.dtype(
    [
        ("albedo", "u1", (VIEWS, SIZE, SIZE, 3)),
        ("normal", "i1", (VIEWS, SIZE, SIZE, 3)),
        ("depth", "f2", (VIEWS, SIZE, SIZE)),
        ("K", "f4", (VIEWS, 3, 3)),
        ("T", "f4", (VIEWS, 4, 4)),
    ]
)


def write_shard(path: Path, seeds: range, *, clusters: int) -> None:
    """Write views of the objects of ``seeds`` atomically; an existing shard is kept."""
    if path.exists():
        return
    found = [cluster for seed in seeds for cluster in object_clusters(seed, clusters=clusters)]
    partial = path.with_suffix(f".{os.getpid()}.partial.npy")
    np.save(partial, np.array(found, _SHARD))
    partial.rename(path)


def read_shard(path: Path) -> Views:
    """A memory-mapped shard: processes that read it share its pages."""
    stored = np.load(path, mmap_mode="r")
    return Views(*(np.asarray(stored[name]) for name in _SHARD.names or ()))


def object_clusters(seed: int, *, clusters: int) -> Iterator[tuple[np.ndarray, ...]]:
    """Clusters of views of one object, as arrays in the order of the fields of Views."""
    mesh, rng = make_training_object(seed), np.random.default_rng([seed, 0x71E3])
    for _ in range(clusters):
        views = [_render_view(mesh, R, rng) for R in _cluster_rotations(rng)]
        yield tuple(np.stack(parts) for parts in zip(*views, strict=True))


def _cluster_rotations(rng: Rng) -> list[Float[np.ndarray, "3 3"]]:
    """R_cam_obj of the views of a cluster."""
    query = random_rotation(rng)
    near = [_rotation(random_direction(rng) * np.radians(rng.uniform(*ring))) @ query for ring in RINGS_DEG]
    axis = np.pi * np.eye(3)[rng.integers(3)]
    flipped = _rotation(random_direction(rng) * np.radians(rng.uniform(0, 15))) @ _rotation(axis) @ query
    return [query, *near, flipped, random_rotation(rng)]


def _rotation(rotvec: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    return np.asarray(cv2.Rodrigues(rotvec)[0])


def _render_view(mesh: Mesh, R: Float[np.ndarray, "3 3"], rng: Rng) -> tuple[np.ndarray, ...]:
    """One view, rendered directly into the crop that the pipeline would cut."""
    T = rigid(R, np.array([*rng.normal(0, 0.4, 2), rng.uniform(6, 14)]))
    wide = np.array([[1000.0, 0, 0], [0, 1000.0, 0], [0, 0, 1]])
    px = project(wide, transform(T, mesh.vertices))
    box = (*(px.min(axis=0)), *(px.max(axis=0)))
    K = square_crop(box, size=SIZE, padding_ratio=1.2) @ wide
    px, albedo, normal, depth = surface_points(mesh, K, T, (SIZE, SIZE))
    maps = np.zeros((SIZE, SIZE, 3), np.uint8), np.zeros((SIZE, SIZE, 3), np.int8)
    near = np.full((SIZE, SIZE), EMPTY_DEPTH, np.float16)
    x, y = px.T
    maps[0][y, x], maps[1][y, x] = np.rint(albedo), np.rint(127 * normal)
    near[y, x] = depth - T[2, 3]
    return *maps, near, K.astype(np.float32), T.astype(np.float32)


TRAINING_SEEDS, VALIDATION_SEEDS = 0, 10_000_000
OBJECTS_PER_SHARD, CLUSTERS_PER_OBJECT = 10, 4


def shard_path(folder: Path, index: int, *, validation: bool = False) -> Path:
    """File of a shard."""
    return folder / f"{'validation' if validation else 'training'}_{index:04d}.npy"


def make_shard(folder: Path, index: int, *, validation: bool = False) -> Path:
    """Path of a shard of training or validation objects, which is made if it does not exist."""
    folder.mkdir(parents=True, exist_ok=True)
    first = (VALIDATION_SEEDS if validation else TRAINING_SEEDS) + index * OBJECTS_PER_SHARD
    path = shard_path(folder, index, validation=validation)
    write_shard(path, range(first, first + OBJECTS_PER_SHARD), clusters=CLUSTERS_PER_OBJECT)
    return path
