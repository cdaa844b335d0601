"""A mesh prepared for ray casting: its faces in an embree scene, and albedo and normal at points of its surface."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from itertools import product
from typing import Generic, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from pipeline.errors import BadInput
from pipeline.functional.camera import project
from pipeline.functional.rigid import transform
from pipeline.functional.shading import DEFAULT_GREY, corner_normals, mip_levels, texel_density, texture_colour
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
        """Pixels (x, y) that the mesh's bounding box covers; all pixels if a corner is behind the camera."""
        points = transform(T_cam_obj, self.box)
        low, high = np.zeros(2), np.array([size_hw[1], size_hw[0]]) - 1.0
        if points[:, 2].min() > 1e-3 * self.radius:
            px = project(K, points)
            low, high = np.maximum(low, np.floor(px.min(axis=0))), np.minimum(high, np.ceil(px.max(axis=0)))
        columns, rows = np.arange(low[0], high[0] + 1, dtype=int), np.arange(low[1], high[1] + 1, dtype=int)
        return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)


class Surface:
    """Albedo and normal at any point of a mesh, interpolated from one row of values per face corner."""

    def __init__(self, mesh: Mesh, crease_deg: float) -> None:
        normals = corner_normals(mesh.vertices, mesh.faces, crease_deg=crease_deg)
        self.levels: tuple[UInt8[np.ndarray, "h w 3"], ...] = ()
        if mesh.texture is not None and mesh.uv is not None:
            self.levels = mip_levels(mesh.texture)
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
        value = np.zeros((len(hits.face), self.corners[0].shape[1]), dtype=np.float32)
        for corner, weight in zip(self.corners, hits.weight.T, strict=True):
            value += corner.take(hits.face, axis=0) * weight[:, None]
        if not self.levels:
            return value[:, 3:], value[:, :3]
        return texture_colour(self.levels, value[:, 3:], self.density.take(hits.face) * footprint_mm), value[:, :3]


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
