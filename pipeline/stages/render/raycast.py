"""mesh -> templates, by ray casting (embree): no system package, no display.

Depth is that of the ray through the pixel's centre; colour is the mean over that ray and ``supersample`` squared rays
more. Faces are drawn from both sides.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any, ClassVar
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from pipeline.errors import BadInput
from pipeline.functional.camera import project
from pipeline.functional.rigid import transform
from pipeline.functional.shading import DEFAULT_GREY, corner_normals, mip_levels, shade, texel_density, texture_colour
from pipeline.items.objects import Mesh
from pipeline.spec import spec
from pipeline.stages.render.cameras import RenderSpec, bounding_sphere, face_vertices, subpixels


@spec
class Raycast(RenderSpec):
    """Templates drawn by embree. Fields: conf/render/raycast.yaml."""

    kind: ClassVar[str] = "render.raycast"
    version: ClassVar[int] = 1

    def render(
        self, mesh: Mesh, K: Float[np.ndarray, "3 3"], T_cam_obj: Float[np.ndarray, "n 4 4"], size_hw: tuple[int, int]
    ) -> tuple[UInt8[np.ndarray, "n H W 3"], Float32[np.ndarray, "n H W"]]:
        """Colour and depth (mm) of the given views; rgb is black where depth is 0."""
        rgb = np.zeros((len(T_cam_obj), *size_hw, 3), dtype=np.uint8)
        depth_mm = np.zeros((len(T_cam_obj), *size_hw), dtype=np.float32)
        for i, T in enumerate(T_cam_obj):
            self._draw(mesh, K, T, rgb[i], depth_mm[i])
        return rgb, depth_mm

    def _draw(
        self,
        mesh: Mesh,
        K: Float[np.ndarray, "3 3"],
        T_cam_obj: Float[np.ndarray, "4 4"],
        rgb: UInt8[np.ndarray, "H W 3"],
        depth_mm: Float32[np.ndarray, "H W"],
    ) -> None:
        caster, surface = _caster(mesh), _surface(mesh, self.crease_deg)
        px = caster.window(K, T_cam_obj, depth_mm.shape)
        centre = caster.cast(K, T_cam_obj, px)
        px = px[centre.ray]
        depth_mm[px[:, 1], px[:, 0]] = centre.depth_mm
        footprint = 1 / (K[0, 0] * self.supersample)
        colour, samples = self._colour(surface, centre, footprint), np.ones(len(px), dtype=np.float32)
        if self.supersample > 1:
            offsets = subpixels(self.supersample)
            apart = (_directions(K, T_cam_obj, offsets) - _directions(K, T_cam_obj, np.zeros((1, 2)))).astype(
                np.float32
            )
            fine = caster.cast_along(T_cam_obj, (centre.direction[:, None] + apart).reshape(-1, 3))
            per_ray = np.zeros((len(px) * len(offsets), 3), dtype=np.float32)
            per_ray[fine.ray] = self._colour(surface, fine, footprint)
            colour = colour + per_ray.reshape(len(px), len(offsets), 3).sum(axis=1)
            samples = samples + np.bincount(fine.ray // len(offsets), minlength=len(px))
        rgb[px[:, 1], px[:, 0]] = np.rint(np.clip(colour / samples[:, None], 0, 255))

    def _colour(self, surface: _Surface, hits: Hits, footprint: float) -> Float32[np.ndarray, "m 3"]:
        """Colour of each hit under a light at the camera, seen through rays as wide as ``footprint`` at 1 mm."""
        albedo, normal = surface.at(hits, footprint_mm=hits.depth_mm * footprint)
        return shade(albedo, normal, hits.direction, ambient=self.ambient, diffuse=self.diffuse)


def render_depth(
    mesh: Mesh,
    K: Float[np.ndarray, "3 3"] | Float[np.ndarray, "n 3 3"],
    T_cam_obj: Float[np.ndarray, "n 4 4"],
    size_hw: tuple[int, int],
) -> Float32[np.ndarray, "n H W"]:
    """Depth maps (mm, 0 = nothing) of a mesh in whole images, one K for all or one for each."""
    depth_mm = np.zeros((len(T_cam_obj), *size_hw), dtype=np.float32)
    caster = _caster(mesh)
    for depth, T, own_K in zip(depth_mm, T_cam_obj, np.broadcast_to(K, (len(T_cam_obj), 3, 3)), strict=True):
        px = caster.window(own_K, T, size_hw)
        hits = caster.cast(own_K, T, px)
        depth[px[hits.ray, 1], px[hits.ray, 0]] = hits.depth_mm
    return depth_mm


def surface_points(
    mesh: Mesh, K: Float[np.ndarray, "3 3"], T_cam_obj: Float[np.ndarray, "4 4"], size_hw: tuple[int, int]
) -> tuple[Int[np.ndarray, "m 2"], Float32[np.ndarray, "m 3"], Float[np.ndarray, "m 3"], Float32[np.ndarray, " m"]]:
    """Of a whole image, the pixels (x, y) that show the mesh, with albedo (0..255), unit normal and depth (mm).

    At pixel centres; normals are in the camera frame and face the camera.
    """
    caster = _caster(mesh)
    px = caster.window(K, T_cam_obj, size_hw)
    hits = caster.cast(K, T_cam_obj, px)
    albedo, normal_obj = _surface(mesh, 40.0).at(hits, footprint_mm=hits.depth_mm / K[0, 0])
    away = np.einsum("mc,mc->m", normal_obj, hits.direction) > 0
    length = np.linalg.norm(normal_obj, axis=-1, keepdims=True)
    normal = np.where(away[:, None], -normal_obj, normal_obj) / np.maximum(length, 1e-30)
    return px[hits.ray], albedo, normal @ T_cam_obj[:3, :3].T, hits.depth_mm


@dataclass(frozen=True, eq=False)
class Hits:
    """Rays that met the mesh: index and direction (object frame, depth 1), face, weights of its corners, depth (mm)."""

    ray: Int[np.ndarray, " m"]
    direction: Float32[np.ndarray, "m 3"]
    face: Int[np.ndarray, " m"]
    weight: Float32[np.ndarray, "m 3"]
    depth_mm: Float32[np.ndarray, " m"]


class _Caster:
    """A mesh in an embree scene.

    embree computes in float32: the scene is centred and rays start just in front of it, so that a step of depth is
    1e-7 of the object, not of its distance. ``robust`` closes the cracks between neighbouring faces.
    """

    def __init__(self, mesh: Mesh) -> None:
        scene, triangles = _embree()
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
        """What the rays through pixels ``px`` meet first. Directions have z = 1 in the camera: length is depth."""
        return self.cast_along(T_cam_obj, _directions(K, T_cam_obj, px).astype(np.float32))

    def cast_along(self, T_cam_obj: Float[np.ndarray, "4 4"], direction: Float32[np.ndarray, "m 3"]) -> Hits:
        """As ``cast``, of directions in the object's frame."""
        R, t = T_cam_obj[:3, :3], T_cam_obj[:3, 3]
        near_mm = max(float((R @ self.centre + t)[2]) - 1.01 * self.radius, 0.0)
        start = np.float32(near_mm) * direction - (R.T @ t + self.centre).astype(np.float32)
        found = self.scene.run(start, direction, output=1)
        ray = np.flatnonzero(found["primID"] >= 0)
        u, v = found["u"][ray], found["v"][ray]
        depth_mm = np.float32(near_mm) + found["tfar"][ray]
        return Hits(ray, direction[ray], found["primID"][ray], np.stack([1 - u - v, u, v], axis=-1), depth_mm)

    def window(
        self, K: Float[np.ndarray, "3 3"], T_cam_obj: Float[np.ndarray, "4 4"], size_hw: tuple[int, ...]
    ) -> Int[np.ndarray, "m 2"]:
        """The pixels (x, y) that the mesh's box may cover; all of them when a corner lies behind the camera."""
        points = transform(T_cam_obj, self.box)
        low, high = np.zeros(2), np.array([size_hw[1], size_hw[0]]) - 1.0
        if points[:, 2].min() > 1e-3 * self.radius:
            px = project(K, points)
            low, high = np.maximum(low, np.floor(px.min(axis=0))), np.minimum(high, np.ceil(px.max(axis=0)))
        columns, rows = np.arange(low[0], high[0] + 1, dtype=int), np.arange(low[1], high[1] + 1, dtype=int)
        return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)


class _Surface:
    """Colour and normal of any point of a mesh: all that is known of a face's corners in one row."""

    def __init__(self, mesh: Mesh, crease_deg: float) -> None:
        normals = corner_normals(mesh.vertices, mesh.faces, crease_deg=crease_deg)
        self.levels: tuple[UInt8[np.ndarray, "h w 3"], ...] = ()
        if mesh.texture is not None and mesh.uv is not None:
            self.levels = mip_levels(mesh.texture)
            self.density = texel_density(mesh.vertices, mesh.faces, mesh.uv, mesh.texture.shape[:2])
            skin = mesh.uv[mesh.faces]
        elif mesh.colours is not None:
            skin = mesh.colours[mesh.faces]
        else:
            skin = np.full((len(mesh.faces), 3, 3), DEFAULT_GREY)
        corners = np.concatenate([normals, skin], axis=-1).astype(np.float32)
        self.corners = tuple(np.ascontiguousarray(corners[:, k]) for k in range(3))

    def at(
        self, hits: Hits, *, footprint_mm: Float[np.ndarray, " m"]
    ) -> tuple[Float32[np.ndarray, "m 3"], Float32[np.ndarray, "m 3"]]:
        """Albedo (0..255) and normal (object frame, of any length) where rays hit, each ``footprint_mm`` wide."""
        value = np.zeros((len(hits.face), self.corners[0].shape[1]), dtype=np.float32)
        for corner, weight in zip(self.corners, hits.weight.T, strict=True):
            value += corner.take(hits.face, axis=0) * weight[:, None]
        if not self.levels:
            return value[:, 3:], value[:, :3]
        return texture_colour(self.levels, value[:, 3:], self.density.take(hits.face) * footprint_mm), value[:, :3]


def _directions(
    K: Float[np.ndarray, "3 3"],
    T_cam_obj: Float[np.ndarray, "4 4"],
    px: Float[np.ndarray, "m 2"] | Int[np.ndarray, "m 2"],
) -> Float[np.ndarray, "m 3"]:
    """Rays through pixels in the object's frame, of depth 1 along the optical axis."""
    A = T_cam_obj[:3, :3].T @ np.linalg.inv(K)
    return px @ A[:, :2].T + A[:, 2]


# for a mesh's other views, as long as the mesh itself lives, and of no more meshes than a dataset's scene may hold
_KEPT = 32
_casters: WeakKeyDictionary[Mesh, _Caster] = WeakKeyDictionary()
_surfaces: WeakKeyDictionary[Mesh, dict[float, _Surface]] = WeakKeyDictionary()


def _caster(mesh: Mesh) -> _Caster:
    if mesh not in _casters:
        _make_room(_casters)
        _casters[mesh] = _Caster(mesh)
    return _casters[mesh]


def _surface(mesh: Mesh, crease_deg: float) -> _Surface:
    if mesh not in _surfaces:
        _make_room(_surfaces)
    of_mesh = _surfaces.setdefault(mesh, {})
    if crease_deg not in of_mesh:
        of_mesh.clear()
        of_mesh[crease_deg] = _Surface(mesh, crease_deg)
    return of_mesh[crease_deg]


def _make_room(kept: WeakKeyDictionary[Mesh, Any]) -> None:
    while len(kept) >= _KEPT:
        kept.pop(next(iter(kept)), None)


def _embree() -> tuple[type, type]:
    try:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    except ImportError as error:
        raise BadInput(
            "render=raycast", found=error, needed="embreex (pip install embreex), or render=pyrender"
        ) from None
    return EmbreeScene, TriangleMesh
