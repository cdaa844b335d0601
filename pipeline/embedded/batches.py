"""shards -> batches: pictures alone, or queries and templates with exact correspondences. A step's batch is its own.

Nothing is kept between steps: a batch depends on seed and step alone, so a resumed training sees what it would have.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from pipeline.embedded.dressing import dressed, scanned
from pipeline.embedded.pictures import Picture, View, photograph, template
from pipeline.embedded.views import (
    CLUSTERS_PER_OBJECT,
    SIZE,
    VIEWS,
    Views,
    make_shard,
    read_shard,
)
from pipeline.functional.rigid import rotation_angle_deg
from pipeline.synthetic.parts import Rng

CELLS = 64  # a side, of descriptors
QUERIES, TEMPLATES = 2, VIEWS - 1  # of a cluster
_SCANS = 0.6  # of the objects, where they are hard, differ from their mesh
_POINTS = 48  # correspondences of a pair at most
_TOLERANCE = 0.03  # of the object's radius: a point this far behind what a template shows there is hidden in it


@dataclass(frozen=True)
class Source:
    """Where shards lie; ``count`` of them, the first few from the start, one more every ``pace`` steps."""

    folder: Path
    count: int
    seed: int = 0
    start: int = 8
    pace: int = 8
    validation: bool = False

    def objects(self, step: int, count: int, *, dress: bool = False) -> tuple[list[list[list[View]]], Rng]:
        """All clusters of views of the objects of a step, dressed or not; the generator of the step's further draws."""
        rng = np.random.default_rng([self.seed, step, 0xBA7C])
        known = min(self.count, self.start + step // self.pace)
        found = []
        for _ in range(count):
            views = _shard(self.folder, int(rng.integers(known)), self.validation)
            first = CLUSTERS_PER_OBJECT * int(rng.integers(len(views) // CLUSTERS_PER_OBJECT))
            clusters = range(first, first + CLUSTERS_PER_OBJECT)
            plain = [[_unpacked(views, k, v) for v in range(VIEWS)] for k in clusters]
            found.append(dressed(plain, rng) if dress else plain)
        return found, rng


@dataclass(frozen=True, eq=False)
class PairBatch:
    """b objects, c clusters of each, q queries and t templates of a cluster.

    Correspondences of each query and template of one cluster, up to m: cells as (x, y), floats; ``matched`` says
    which of them are. ``angle_deg`` lies between each query's rotation and that of every template of its object.
    """

    rgb: UInt8[Tensor, "n S S 3"]
    mask: Bool[Tensor, "n S S"]
    query_xy: Float[Tensor, "b c q t m 2"]
    template_xy: Float[Tensor, "b c q t m 2"]
    matched: Bool[Tensor, "b c q t m"]
    angle_deg: Float[Tensor, "b c q ct"]

    def on(self, device: torch.device) -> PairBatch:
        """The same on another device."""
        return PairBatch(*(getattr(self, field.name).to(device, non_blocking=True) for field in fields(self)))


def picture_batch(source: Source, step: int, *, count: int) -> UInt8[Tensor, "n S S 3"]:
    """Pictures of all sorts, each of another object: two in three are photographs."""
    objects, rng = source.objects(step, count)
    views = [clusters[int(rng.integers(len(clusters)))][int(rng.integers(VIEWS))] for clusters in objects]
    made = [photograph(v, rng) if rng.uniform() < 0.67 else template(v, rng) for v in views]
    return torch.from_numpy(np.stack([p.rgb for p in made]))


def pair_batch(source: Source, step: int, *, count: int, hard: bool = True) -> PairBatch:
    """Two photographs of the query's view of every cluster of ``count`` objects, and its other views as templates.

    ``hard``: with surfaces of their own (dressing), meshes that are not quite like them, other objects in front of
    them, shadows and worse masks.
    """
    objects, rng = source.objects(step, count, dress=hard)
    pictures: list[Picture] = []
    parts, angles = [], []
    for clusters, others in zip(objects, objects[1:] + objects[:1], strict=True):
        meshes = scanned(clusters, rng) if hard and rng.uniform() < _SCANS else clusters
        for views, drawn in zip(clusters, meshes, strict=True):
            queries = [photograph(views[0], rng, other=_any(others, rng) if hard else None) for _ in range(QUERIES)]
            pictures += queries + [template(view, rng) for view in drawn[1:]]
            parts += [_correspondences(q, views[0], t, rng) for q in queries for t in views[1:]]
        R_template = _rotations([view for views in clusters for view in views[1:]])
        for views in clusters:
            R_query = np.broadcast_to(_rotations(views[:1]), R_template.shape)
            angles += [rotation_angle_deg(R_query, R_template)] * QUERIES
    q, t, ok = (torch.from_numpy(np.stack(p)) for p in zip(*parts, strict=True))
    shape = (count, CLUSTERS_PER_OBJECT, QUERIES, TEMPLATES, _POINTS)
    return PairBatch(
        torch.from_numpy(np.stack([p.rgb for p in pictures])),
        torch.from_numpy(np.stack([p.mask for p in pictures])),
        q.reshape(*shape, 2),
        t.reshape(*shape, 2),
        ok.reshape(shape),
        torch.from_numpy(np.stack(angles).astype(np.float32)).reshape(*shape[:3], -1),
    )


def _any(clusters: list[list[View]], rng: Rng) -> View:
    views = clusters[int(rng.integers(len(clusters)))]
    return views[int(rng.integers(len(views)))]


def _rotations(views: list[View]) -> Float[np.ndarray, "n 3 3"]:
    return np.stack([view.T[:3, :3] for view in views]).astype(np.float64)


@lru_cache(maxsize=1000)
def _shard(folder: Path, index: int, validation: bool) -> Views:
    return read_shard(make_shard(folder, index, validation=validation))


def _unpacked(views: Views, cluster: int, view: int) -> View:
    return View(
        views.albedo[cluster, view],
        views.normal[cluster, view].astype(np.float32) / 127,
        views.depth[cluster, view].astype(np.float32),
        views.K[cluster, view],
        views.T[cluster, view],
    )


def _correspondences(
    query: Picture, view: View, other: View, rng: Rng
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2"], Bool[np.ndarray, " m"]]:
    """Cells of the query, drawn from those that another view shows as well, and where it shows them."""
    stride = SIZE / CELLS
    cell_xy = np.stack(np.meshgrid(np.arange(CELLS), np.arange(CELLS)), axis=-1).reshape(-1, 2)
    crop_px = (cell_xy + 0.5) * stride - 0.5
    scale, shift = query.A_crop_view[0, 0], query.A_crop_view[:2, 2]
    px = (crop_px - shift) / scale
    inside = (px >= 0).all(1) & (px <= SIZE - 1).all(1)
    x, y = np.rint(np.where(inside[:, None], px, 0)).astype(int).T
    at = np.rint(crop_px).astype(int)
    inside &= query.seen[y, x] & view.mask[y, x] & query.mask[at[:, 1], at[:, 0]]
    other_px, visible = _seen_in(other, _object_points(view, px[inside]))
    found = np.flatnonzero(visible)
    found = found[rng.permutation(len(found))[:_POINTS]]
    rows = np.zeros((2, _POINTS, 2), np.float32)
    rows[0, : len(found)] = cell_xy[inside][found]
    rows[1, : len(found)] = (other_px[found] + 0.5) / stride - 0.5
    return rows[0], rows[1], np.arange(_POINTS) < len(found)


def _object_points(view: View, px: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 3"]:
    x, y = np.rint(px).astype(int).T
    z = view.depth[y, x] + view.T[2, 3]
    K, T = view.K.astype(np.float64), view.T.astype(np.float64)
    points = np.stack([(px[:, 0] - K[0, 2]) / K[0, 0] * z, (px[:, 1] - K[1, 2]) / K[1, 1] * z, z], axis=-1)
    return (points - T[:3, 3]) @ T[:3, :3]


def _seen_in(view: View, points: Float[np.ndarray, "m 3"]) -> tuple[Float[np.ndarray, "m 2"], Bool[np.ndarray, " m"]]:
    """Pixels of object points in a view, and whether nothing hides them there."""
    T, K = view.T.astype(np.float64), view.K.astype(np.float64)
    in_camera = points @ T[:3, :3].T + T[:3, 3]
    px = in_camera[:, :2] / in_camera[:, 2:] * [K[0, 0], K[1, 1]] + K[:2, 2]
    x, y = np.clip(np.rint(px), 0, SIZE - 1).astype(int).T
    return px, np.abs(view.depth[y, x] + T[2, 3] - in_camera[:, 2]) < _TOLERANCE
