"""A mesh prepared for ray casting: its faces in an embree scene, and albedo and normal at points of its surface."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from itertools import product
from typing import Generic, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float, Float32, Int

from pipeline.errors import BadInput
from pipeline.functional.camera import project
from pipeline.functional.rigid import transform
from pipeline.functional.shading import DEFAULT_GREY, Mipmap, corner_normals, mip_levels, texel_density, texture_colour
from pipeline.items.objects import Mesh
from pipeline.stages.render.cameras import bounding_sphere, face_vertices

MAX_MESHES = 32  # more than a scene of a dataset shows
Value = TypeVar("Value")


@dataclass(frozen=True, eq=False)
class Hits:
    """Rays that hit the mesh: index, direction (object frame, depth 1), face, barycentric weights, and depth (mm)."""

    ray: Int[np.ndarray, " m"]
    direction: Float32[np.ndarray, "m 3"]
    face: Int[np.ndarray, " m"]
    weight: Float32[np.ndarray, "m 3"]
    depth_mm: Float32[np.ndarray, " m"]

    def __getitem__(self, part: slice) -> Hits:
        """Some of the hits."""
        return Hits(self.ray[part], self.direction[part], self.face[part], self.weight[part], self.depth_mm[part])


class Caster:
    """A mesh in an embree scene.

    embree computes in float32. The scene is therefore centred and rays start just in front of it, so that depth is
    accurate to 1e-7 of the object's size, not of its distance. ``robust``: no ray passes between adjacent faces.
    """

    def __init__(self, mesh: Mesh) -> None:
        scene, triangles = _import_embree()
        self.centre, self.radius = bounding_sphere(mesh)
        used = face_vertices(mesh)
        self.box = np.array(list(product(*zip(used.min(axis=0), used.max(axis=0), strict=True))))
        self.scene = scene(robust=True)
        local = (mesh.vertices - self.centre).astype(np.float32)
        self.kept_alive = triangles(self.scene, local, np.ascontiguousarray(mesh.faces, dtype=np.int32))

    def cast(
        self,
        K: Float[np.ndarray, "3 3"],
        T_cam_obj: Float[np.ndarray, "4 4"],
        px: Float[np.ndarray, "m 2"] | Int[np.ndarray, "m 2"],
    ) -> Hits:
        """First hits of the rays through pixels ``px``. Directions have z = 1 in the camera: distance is depth."""
        return self.cast_along(T_cam_obj, ray_directions(K, T_cam_obj, px).astype(np.float32))

    def cast_along(self, T_cam_obj: Float[np.ndarray, "4 4"], direction: Float32[np.ndarray, "m 3"]) -> Hits:
        """As ``cast``, for directions in the object's frame."""
        R, t = T_cam_obj[:3, :3], T_cam_obj[:3, 3]
        near_mm = max(float((R @ self.centre + t)[2]) - 1.01 * self.radius, 0.0)
        start = np.float32(near_mm) * direction - (R.T @ t + self.centre).astype(np.float32)
        found = self.scene.run(start, direction, output=1)
        ray = np.flatnonzero(found["primID"] >= 0)
        u, v = found["u"][ray], found["v"][ray]
        depth_mm = np.float32(near_mm) + found["tfar"][ray]
        return Hits(ray, direction[ray], found["primID"][ray], np.stack([1 - u - v, u, v], axis=-1), depth_mm)

    def covered_pixels(
        self, K: Float[np.ndarray, "3 3"], T_cam_obj: Float[np.ndarray, "4 4"], size_hw: tuple[int, ...]
    ) -> Int[np.ndarray, "m 2"]:
        """Pixels (x, y) that the mesh's bounding box covers, by rows; all pixels if a corner is behind the camera."""
        points = transform(T_cam_obj, self.box)
        rows, last_column = np.arange(size_hw[0]), size_hw[1] - 1
        left, right = np.zeros(len(rows), int), np.full(len(rows), last_column)
        if points[:, 2].min() > 1e-3 * self.radius:
            px = project(K, points)
            rows = rows[(rows >= np.floor(px[:, 1].min())) & (rows <= np.ceil(px[:, 1].max()))]
            low, high = _row_spans(px, rows)
            left, right = (edge.clip(-1, last_column + 1).astype(int) for edge in (np.floor(low), np.ceil(high)))
            left, right = np.maximum(left, 0), np.minimum(right, last_column)
        width = np.maximum(right - left + 1, 0)
        in_row = np.arange(width.sum()) - np.repeat(np.cumsum(width) - width, width)
        return np.stack([np.repeat(left, width) + in_row, np.repeat(rows, width)], axis=-1)


class Surface:
    """Albedo and normal at any point of a mesh, interpolated from one row of values per face corner."""

    def __init__(self, mesh: Mesh, crease_deg: float) -> None:
        normals = corner_normals(mesh.vertices, mesh.faces, crease_deg=crease_deg)
        self.texture: Mipmap | None = None
        if mesh.texture is not None and mesh.uv is not None:
            self.texture = Mipmap.of(mip_levels(mesh.texture))
            self.density = texel_density(mesh.vertices, mesh.faces, mesh.uv, mesh.texture.shape[:2])
            colours = mesh.uv[mesh.faces]
        elif mesh.colours is not None:
            colours = mesh.colours[mesh.faces]
        else:
            colours = np.full((len(mesh.faces), 3, 3), DEFAULT_GREY)
        corners = np.concatenate([normals, colours], axis=-1).astype(np.float32)
        self.corners = tuple(np.ascontiguousarray(corners[:, k]) for k in range(3))

    def sample(
        self, hits: Hits, *, footprint_mm: Float[np.ndarray, " m"]
    ) -> tuple[Float32[np.ndarray, "m 3"], Float32[np.ndarray, "m 3"]]:
        """Albedo (0..255) and normal (object frame, not normalised) at hits of rays that are ``footprint_mm`` wide."""
        value = self.corners[0].take(hits.face, axis=0) * hits.weight[:, :1]
        for k in (1, 2):
            value += self.corners[k].take(hits.face, axis=0) * hits.weight[:, k : k + 1]
        if self.texture is None:
            return value[:, 3:], value[:, :3]
        return texture_colour(self.texture, value[:, 3:], self.density.take(hits.face) * footprint_mm), value[:, :3]


def _row_spans(
    px: Float[np.ndarray, "k 2"], rows: Int[np.ndarray, " h"]
) -> tuple[Float[np.ndarray, " h"], Float[np.ndarray, " h"]]:
    """Where the convex hull of a few points begins and ends in each row of pixels.

    The hull's edges are among the lines between any two points. Rows above or below it get the span of its nearest end.
    """
    first, second = np.triu_indices(len(px), 1)
    a, step = px[first], px[second] - px[first]
    y = rows.clip(px[:, 1].min(), px[:, 1].max())[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (y - a[:, 1]) / step[:, 1]
    crosses = (along > -1e-9) & (along < 1 + 1e-9)
    x = a[:, 0] + np.where(crosses, along, 0.0) * step[:, 0]
    low, high = np.where(crosses, x, np.inf).min(axis=1), np.where(crosses, x, -np.inf).max(axis=1)
    is_line = ~crosses.any(axis=1)  # all points in one row
    return np.where(is_line, px[:, 0].min(), low), np.where(is_line, px[:, 0].max(), high)


def ray_directions(
    K: Float[np.ndarray, "3 3"],
    T_cam_obj: Float[np.ndarray, "4 4"],
    px: Float[np.ndarray, "m 2"] | Int[np.ndarray, "m 2"],
) -> Float[np.ndarray, "m 3"]:
    """Directions in the object's frame of the rays through pixels; depth 1 along the optical axis."""
    A = T_cam_obj[:3, :3].T @ np.linalg.inv(K)
    return px @ A[:, :2].T + A[:, 2]


class MeshMemo(Generic[Value]):
    """One value per mesh, kept while the mesh is alive; the oldest is dropped beyond ``max_meshes``.

    A mesh is rendered many times, and building its scene takes longer than rendering a view.
    """

    def __init__(self, max_meshes: int) -> None:
        self.max_meshes = max_meshes
        self._values: WeakKeyDictionary[Mesh, tuple[Hashable, Value]] = WeakKeyDictionary()

    def get(self, mesh: Mesh, key: Hashable, build: Callable[[], Value]) -> Value:
        """The mesh's value; built where there is none, or where it was built for another ``key``."""
        stored = self._values.get(mesh)
        if stored is not None and stored[0] == key:
            return stored[1]
        while stored is None and len(self._values) >= self.max_meshes:
            self._values.pop(next(iter(self._values)), None)
        value = build()
        self._values[mesh] = key, value
        return value


_casters: MeshMemo[Caster] = MeshMemo(MAX_MESHES)
_surfaces: MeshMemo[Surface] = MeshMemo(MAX_MESHES)


def get_caster(mesh: Mesh) -> Caster:
    """The mesh's embree scene, built once. Raises BadInput where embreex cannot be imported."""
    return _casters.get(mesh, None, lambda: Caster(mesh))


def get_surface(mesh: Mesh, crease_deg: float) -> Surface:
    """The mesh's surface, built once for the last ``crease_deg``."""
    return _surfaces.get(mesh, crease_deg, lambda: Surface(mesh, crease_deg))


def _import_embree() -> tuple[type, type]:
    try:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    except ImportError as error:
        raise BadInput(
            "render=raycast", found=error, needed="embreex (pip install embreex), or render=pyrender"
        ) from None
    return EmbreeScene, TriangleMesh
