"""Shards -> batches of pictures, or of queries and templates with exact correspondences.

A batch depends only on seed and step, so a resumed training sees the same batches as an uninterrupted one.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from pipeline.embedded.pictures import Picture, View, render_photograph, render_template
from pipeline.embedded.surfaces import imitate_scan, repaint
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

CELLS = 64  # side of the descriptors' map
QUERIES, TEMPLATES = 2, VIEWS - 1  # per cluster
_SCANS = 0.6  # share of objects in hard batches whose templates imitate an imperfect mesh
_MAX_POINTS = 48  # correspondences of a pair
_TOLERANCE = 0.03  # of the object's radius; a point farther behind the template's surface is hidden in it


@dataclass(frozen=True)
class Source:
    """Folder of ``count`` shards; the first ``start`` are used from the beginning, one more every ``pace`` steps."""

    folder: Path
    count: int
    seed: int = 0
    start: int = 8
    pace: int = 8
    validation: bool = False

    def objects(self, step: int, count: int, *, repainted: bool = False) -> tuple[list[list[list[View]]], Rng]:
        """All clusters of views of a step's objects, and the generator for the step's further random choices."""
        rng = np.random.default_rng([self.seed, step, 0xBA7C])
        available = min(self.count, self.start + step // self.pace)
        found = []
        for _ in range(count):
            views = _shard(self.folder, int(rng.integers(available)), self.validation)
            first = CLUSTERS_PER_OBJECT * int(rng.integers(len(views) // CLUSTERS_PER_OBJECT))
            clusters = range(first, first + CLUSTERS_PER_OBJECT)
            plain = [[_unpack(views, k, v) for v in range(VIEWS)] for k in clusters]
            found.append(repaint(plain, rng) if repainted else plain)
        return found, rng


@dataclass(frozen=True, eq=False)
class PairBatch:
    """b objects, each with c clusters of q queries and t templates.

    ``query_xy``, ``template_xy``: up to m correspondences of each query with each template of its cluster, cells;
    ``matched``: which of the m are valid. ``angle_deg``: between each query and every template of its object.
    """

    rgb: UInt8[Tensor, "n S S 3"]
    mask: Bool[Tensor, "n S S"]
    query_xy: Float[Tensor, "b c q t m 2"]
    template_xy: Float[Tensor, "b c q t m 2"]
    matched: Bool[Tensor, "b c q t m"]
    angle_deg: Float[Tensor, "b c q ct"]

    def to(self, device: torch.device) -> PairBatch:
        """The batch on another device."""
        return PairBatch(*(getattr(self, field.name).to(device, non_blocking=True) for field in fields(self)))


def picture_batch(source: Source, step: int, *, count: int) -> UInt8[Tensor, "n S S 3"]:
    """Pictures of different objects; two thirds are photographs, the others templates."""
    objects, rng = source.objects(step, count)
    views = [clusters[int(rng.integers(len(clusters)))][int(rng.integers(VIEWS))] for clusters in objects]
    made = [render_photograph(v, rng) if rng.uniform() < 0.67 else render_template(v, rng) for v in views]
    return torch.from_numpy(np.stack([p.rgb for p in made]))


def pair_batch(source: Source, step: int, *, count: int, hard: bool = True) -> PairBatch:
    """For every cluster of ``count`` objects, two photographs of the query's view and its other views as templates.

    ``hard``: with random surfaces, templates of imperfect meshes, occluding objects, shadows and worse masks.
    """
    objects, rng = source.objects(step, count, repainted=hard)
    pictures: list[Picture] = []
    parts, angles = [], []
    for clusters, others in zip(objects, objects[1:] + objects[:1], strict=True):
        meshes = imitate_scan(clusters, rng) if hard and rng.uniform() < _SCANS else clusters
        for views, drawn in zip(clusters, meshes, strict=True):
            queries = [
                render_photograph(views[0], rng, other=_pick_view(others, rng) if hard else None)
                for _ in range(QUERIES)
            ]
            pictures += queries + [render_template(view, rng) for view in drawn[1:]]
            parts += [_correspondences(q, views[0], t, rng) for q in queries for t in views[1:]]
        R_template = _rotations([view for views in clusters for view in views[1:]])
        for views in clusters:
            R_query = np.broadcast_to(_rotations(views[:1]), R_template.shape)
            angles += [rotation_angle_deg(R_query, R_template)] * QUERIES
    q, t, ok = (torch.from_numpy(np.stack(p)) for p in zip(*parts, strict=True))
    shape = (count, CLUSTERS_PER_OBJECT, QUERIES, TEMPLATES, _MAX_POINTS)
    return PairBatch(
        torch.from_numpy(np.stack([p.rgb for p in pictures])),
        torch.from_numpy(np.stack([p.mask for p in pictures])),
        q.reshape(*shape, 2),
        t.reshape(*shape, 2),
        ok.reshape(shape),
        torch.from_numpy(np.stack(angles).astype(np.float32)).reshape(*shape[:3], -1),
    )


def _pick_view(clusters: list[list[View]], rng: Rng) -> View:
    views = clusters[int(rng.integers(len(clusters)))]
    return views[int(rng.integers(len(views)))]


def _rotations(views: list[View]) -> Float[np.ndarray, "n 3 3"]:
    return np.stack([view.T[:3, :3] for view in views]).astype(np.float64)


@lru_cache(maxsize=1000)
def _shard(folder: Path, index: int, validation: bool) -> Views:
    """A shard, memory-mapped; the cache holds maps, not their content."""
    return read_shard(make_shard(folder, index, validation=validation))


def _unpack(views: Views, cluster: int, view: int) -> View:
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
    """Random cells of the query that another view also shows, their positions in it, and which entries are valid."""
    stride = SIZE / CELLS
    cell_xy = np.stack(np.meshgrid(np.arange(CELLS), np.arange(CELLS)), axis=-1).reshape(-1, 2)
    crop_px = (cell_xy + 0.5) * stride - 0.5
    scale, shift = query.A_crop_view[0, 0], query.A_crop_view[:2, 2]
    px = (crop_px - shift) / scale
    inside = (px >= 0).all(1) & (px <= SIZE - 1).all(1)
    x, y = np.rint(np.where(inside[:, None], px, 0)).astype(int).T
    at = np.rint(crop_px).astype(int)
    inside &= query.visible[y, x] & view.mask[y, x] & query.mask[at[:, 1], at[:, 0]]
    other_px, visible = _project_visible(other, _object_points(view, px[inside]))
    found = np.flatnonzero(visible)
    found = found[rng.permutation(len(found))[:_MAX_POINTS]]
    rows = np.zeros((2, _MAX_POINTS, 2), np.float32)
    rows[0, : len(found)] = cell_xy[inside][found]
    rows[1, : len(found)] = (other_px[found] + 0.5) / stride - 0.5
    return rows[0], rows[1], np.arange(_MAX_POINTS) < len(found)


def _object_points(view: View, px: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 3"]:
    x, y = np.rint(px).astype(int).T
    z = view.depth[y, x] + view.T[2, 3]
    K, T = view.K.astype(np.float64), view.T.astype(np.float64)
    points = np.stack([(px[:, 0] - K[0, 2]) / K[0, 0] * z, (px[:, 1] - K[1, 2]) / K[1, 1] * z, z], axis=-1)
    return (points - T[:3, 3]) @ T[:3, :3]


def _project_visible(
    view: View, points: Float[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, "m 2"], Bool[np.ndarray, " m"]]:
    """Pixels of object points in a view, and whether they are visible there."""
    T, K = view.T.astype(np.float64), view.K.astype(np.float64)
    in_camera = points @ T[:3, :3].T + T[:3, 3]
    px = in_camera[:, :2] / in_camera[:, 2:] * [K[0, 0], K[1, 1]] + K[:2, 2]
    x, y = np.clip(np.rint(px), 0, SIZE - 1).astype(int).T
    return px, np.abs(view.depth[y, x] + T[2, 3] - in_camera[:, 2]) < _TOLERANCE
