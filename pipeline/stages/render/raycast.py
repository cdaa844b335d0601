"""mesh -> templates, by ray casting (embree); needs no system package and no display.

Depth is that of the ray through the pixel's centre. Colour is the mean over that ray and a grid of ``supersample`` x
``supersample`` further rays. Faces are visible from both sides.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from pipeline.functional.shading import shade
from pipeline.items.objects import Mesh
from pipeline.spec import spec
from pipeline.stages.render.cameras import RenderSpec, subpixels
from pipeline.stages.render.ray_mesh import Caster, Hits, Surface, get_caster, get_surface, ray_directions

_RAYS = 1 << 15  # rays that are cast and shaded at a time: what they take fits in the cache
DEPTH_VERSION = 1
"""Version of ``render_depth``, on which scores and oracles depend. When depth changes, raise it and Raycast.version."""


@spec
class Raycast(RenderSpec):
    """Templates rendered by embree. Fields: conf/render/raycast.yaml."""

    kind: ClassVar[str] = "render.raycast"
    version: ClassVar[int] = 1

    def render(
        self, mesh: Mesh, K: Float[np.ndarray, "3 3"], T_cam_obj: Float[np.ndarray, "n 4 4"], size_hw: tuple[int, int]
    ) -> tuple[UInt8[np.ndarray, "n H W 3"], Float32[np.ndarray, "n H W"]]:
        """As Renderer.render."""
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
        caster, surface = get_caster(mesh), get_surface(mesh, self.crease_deg)
        px = caster.covered_pixels(K, T_cam_obj, depth_mm.shape)
        centre = caster.cast(K, T_cam_obj, px)
        px = px[centre.ray]
        depth_mm[px[:, 1], px[:, 0]] = centre.depth_mm
        at_origin = ray_directions(K, T_cam_obj, np.zeros((1, 2)))
        shifts = (ray_directions(K, T_cam_obj, subpixels(self.supersample)) - at_origin).astype(np.float32)
        footprint = 1 / (K[0, 0] * self.supersample)
        block = _RAYS // len(shifts)
        for first in range(0, len(px), block):
            x, y = px[first : first + block].T
            colour = self._colour(caster, surface, T_cam_obj, centre[first : first + block], shifts, footprint)
            rgb[y, x] = np.rint(np.clip(colour, 0, 255))

    def _colour(
        self,
        caster: Caster,
        surface: Surface,
        T_cam_obj: Float[np.ndarray, "4 4"],
        centre: Hits,
        shifts: Float32[np.ndarray, "s 3"],
        footprint: float,
    ) -> Float32[np.ndarray, "m 3"]:
        """Mean colour of each pixel: of the ray through its centre, and of the further rays that hit the mesh."""
        colour = self._shade(surface, centre, footprint)
        if self.supersample == 1:
            return colour
        fine = caster.cast_along(T_cam_obj, (centre.direction[:, None] + shifts).reshape(-1, 3))
        per_ray = np.zeros((len(colour) * len(shifts), 3), dtype=np.float32)
        per_ray[fine.ray] = self._shade(surface, fine, footprint)
        per_pixel = per_ray.reshape(len(colour), len(shifts), 3)
        total = per_pixel[:, 0].copy()
        for sample in range(1, len(shifts)):  # numpy's sum over so short an axis takes several times as long
            total += per_pixel[:, sample]
        samples = 1 + np.bincount(fine.ray // len(shifts), minlength=len(colour)).astype(np.float32)
        return (colour + total) / samples[:, None]

    def _shade(self, surface: Surface, hits: Hits, footprint: float) -> Float32[np.ndarray, "m 3"]:
        """Colour of each hit, lit from the camera; rays are ``footprint`` mm wide at a depth of 1 mm."""
        albedo, normal = surface.sample(hits, footprint_mm=hits.depth_mm * footprint)
        return shade(albedo, normal, hits.direction, ambient=self.ambient, diffuse=self.diffuse)


def render_depth(
    mesh: Mesh,
    K: Float[np.ndarray, "3 3"] | Float[np.ndarray, "n 3 3"],
    T_cam_obj: Float[np.ndarray, "n 4 4"],
    size_hw: tuple[int, int],
) -> Float32[np.ndarray, "n H W"]:
    """Depth maps (mm, 0 for background) of a mesh in full images; one K for all poses, or one for each."""
    depth_mm = np.zeros((len(T_cam_obj), *size_hw), dtype=np.float32)
    caster = get_caster(mesh)
    for depth, T, K_view in zip(depth_mm, T_cam_obj, np.broadcast_to(K, (len(T_cam_obj), 3, 3)), strict=True):
        px = caster.covered_pixels(K_view, T, size_hw)
        hits = caster.cast(K_view, T, px)
        depth[px[hits.ray, 1], px[hits.ray, 0]] = hits.depth_mm
    return depth_mm


def surface_points(
    mesh: Mesh, K: Float[np.ndarray, "3 3"], T_cam_obj: Float[np.ndarray, "4 4"], size_hw: tuple[int, int]
) -> tuple[Int[np.ndarray, "m 2"], Float32[np.ndarray, "m 3"], Float[np.ndarray, "m 3"], Float32[np.ndarray, " m"]]:
    """Pixels (x, y) of an image that show the mesh, with albedo (0..255), unit normal and depth (mm) at their centres.

    Normals are in the camera frame and face the camera.
    """
    caster = get_caster(mesh)
    px = caster.covered_pixels(K, T_cam_obj, size_hw)
    hits = caster.cast(K, T_cam_obj, px)
    albedo, normal_obj = get_surface(mesh, 40.0).sample(hits, footprint_mm=hits.depth_mm / K[0, 0])
    faces_away = np.einsum("mc,mc->m", normal_obj, hits.direction) > 0
    length = np.linalg.norm(normal_obj, axis=-1, keepdims=True)
    normal = np.where(faces_away[:, None], -normal_obj, normal_obj) / np.maximum(length, 1e-30)
    return px[hits.ray], albedo, normal @ T_cam_obj[:3, :3].T, hits.depth_mm
