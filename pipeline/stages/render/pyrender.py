"""mesh -> templates, by OpenGL through EGL (pyrender): needs no display, but the system's GL libraries.

pyrender draws albedo, object normals (as colours) and depth without light; shading is then the same computation as the
ray caster's. Depth comes from a pass without multisampling, whose samples are at the pixels' centres.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float, Float32, UInt8

from pipeline.errors import BadInput
from pipeline.functional.camera import resize_affine
from pipeline.functional.rigid import inverse
from pipeline.functional.shading import DEFAULT_GREY, corner_normals, shade
from pipeline.items.objects import Mesh
from pipeline.spec import spec
from pipeline.stages.render.cameras import RenderSpec, bounding_sphere

_GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's camera looks along -z with y up


@spec
class Pyrender(RenderSpec):
    """Templates rendered by pyrender. Fields: conf/render/pyrender.yaml."""

    kind: ClassVar[str] = "render.pyrender"
    version: ClassVar[int] = 1

    def render(
        self, mesh: Mesh, K: Float[np.ndarray, "3 3"], T_cam_obj: Float[np.ndarray, "n 4 4"], size_hw: tuple[int, int]
    ) -> tuple[UInt8[np.ndarray, "n H W 3"], Float32[np.ndarray, "n H W"]]:
        """As Renderer.render."""
        rgb = np.zeros((len(T_cam_obj), *size_hw, 3), dtype=np.uint8)
        depth_mm = np.zeros((len(T_cam_obj), *size_hw), dtype=np.float32)
        K_fine = resize_affine(float(self.supersample)) @ K
        with _open_canvas(mesh, self.crease_deg) as canvas:
            for i, T in enumerate(T_cam_obj):
                depth_mm[i] = canvas.depth_mm(K, T, size_hw)
                total, covered = self._shade(canvas, K, T, size_hw, 1)
                if self.supersample > 1:
                    fine, fine_covered = self._shade(canvas, K_fine, T, size_hw, self.supersample)
                    total, covered = total + fine, covered + fine_covered
                mean = np.rint(np.clip(total / np.maximum(covered, 1e-6), 0, 255))
                rgb[i] = np.where(depth_mm[i][..., None] > 0, mean, 0)
        return rgb, depth_mm

    def _shade(
        self,
        canvas: _Canvas,
        K: Float[np.ndarray, "3 3"],
        T_cam_obj: Float[np.ndarray, "4 4"],
        size_hw: tuple[int, int],
        s: int,
    ) -> tuple[Float[np.ndarray, "H W 3"], Float[np.ndarray, "H W 1"]]:
        """Sums over the s x s samples of each pixel: of colour times coverage, and of coverage."""
        h, w = size_hw[0] * s, size_hw[1] * s
        albedo, normal = canvas.albedo_and_normal(K, T_cam_obj, (h, w))
        covered = albedo[..., 3:] / 255.0
        # colours are blended with black at the outline; dividing by the coverage reverses that
        albedo, normal = (layer[..., :3] / np.maximum(layer[..., 3:], 1.0) for layer in (albedo, normal))
        px = np.stack(np.meshgrid(np.arange(w), np.arange(h)), axis=-1)
        A = T_cam_obj[:3, :3].T @ np.linalg.inv(K)
        rays_obj = px @ A[:, :2].T + A[:, 2]
        colour = shade(255 * albedo, 2 * normal - 1, rays_obj, ambient=self.ambient, diffuse=self.diffuse)
        tiles = (size_hw[0], s, size_hw[1], s, -1)
        return (colour * covered).reshape(tiles).sum(axis=(1, 3)), covered.reshape(tiles).sum(axis=(1, 3))


class _Canvas:
    """A mesh in an OpenGL context three times: with its albedo, with its normals as colours, and plain, for depth.

    Vertices are relative to the centre of the mesh, as in the ray caster.
    """

    def __init__(self, gl: Any, mesh: Mesh, crease_deg: float) -> None:
        self.gl = gl
        self.centre, self.radius = bounding_sphere(mesh)
        self.scene = gl.Scene(bg_color=(0.0, 0.0, 0.0, 0.0))
        local = mesh.vertices - self.centre
        self.albedo = self.scene.add(gl.Mesh([_albedo_primitive(gl, mesh, local)]))
        # pyrender culls back faces in its segmentation pass, used for depth, so each face is added in both orientations
        both_sides = np.concatenate([mesh.faces, mesh.faces[:, ::-1]])
        self.plain = self.scene.add(gl.Mesh([gl.Primitive(local, indices=both_sides)]))
        corners = local[mesh.faces].reshape(-1, 3)
        coded = (corner_normals(mesh.vertices, mesh.faces, crease_deg=crease_deg).reshape(-1, 3) + 1) / 2
        opaque = np.concatenate([coded, np.ones((len(coded), 1))], axis=-1).astype(np.float32)
        self.normals = self.scene.add(gl.Mesh([gl.Primitive(corners, color_0=opaque, material=_two_sided(gl))]))
        self.camera = self.scene.add(gl.IntrinsicsCamera(1, 1, 0, 0, znear=1, zfar=2))
        self.renderer = gl.OffscreenRenderer(8, 8)

    def depth_mm(
        self, K: Float[np.ndarray, "3 3"], T_cam_obj: Float[np.ndarray, "4 4"], size_hw: tuple[int, int]
    ) -> Float32[np.ndarray, "H W"]:
        """Depth at pixel centres."""
        self._aim(K, T_cam_obj, size_hw)
        self._show(self.plain)
        colour = {self.plain: (255, 255, 255)}
        _, depth = self.renderer.render(self.scene, flags=self.gl.RenderFlags.SEG, seg_node_map=colour)
        return np.asarray(depth, dtype=np.float32)

    def albedo_and_normal(
        self, K: Float[np.ndarray, "3 3"], T_cam_obj: Float[np.ndarray, "4 4"], size_hw: tuple[int, int]
    ) -> tuple[Float[np.ndarray, "H W 4"], Float[np.ndarray, "H W 4"]]:
        """Albedo, and normals n as (n + 1) / 2, both times coverage; the fourth channel is coverage; 0..255."""
        self._aim(K, T_cam_obj, size_hw)
        flags = self.gl.RenderFlags.FLAT | self.gl.RenderFlags.RGBA | self.gl.RenderFlags.SKIP_CULL_FACES
        layers = []
        for node in (self.albedo, self.normals):
            self._show(node)
            layers.append(self.renderer.render(self.scene, flags=flags)[0].astype(np.float64))
        return layers[0], layers[1]

    def _show(self, only: Any) -> None:
        for node in (self.albedo, self.normals, self.plain):
            node.mesh.is_visible = node is only

    def _aim(self, K: Float[np.ndarray, "3 3"], T_cam_obj: Float[np.ndarray, "4 4"], size_hw: tuple[int, int]) -> None:
        self.renderer.viewport_height, self.renderer.viewport_width = size_hw
        camera = self.camera.camera
        camera.fx, camera.fy = K[0, 0], K[1, 1]
        camera.cx, camera.cy = K[0, 2] + 0.5, K[1, 2] + 0.5  # OpenGL's pixel 0 spans 0 to 1
        T_cam_centred = T_cam_obj.copy()
        T_cam_centred[:3, 3] += T_cam_obj[:3, :3] @ self.centre
        middle = T_cam_centred[2, 3]
        camera.znear = max(middle - 1.05 * self.radius, 1e-3 * self.radius)
        camera.zfar = max(middle, 0.0) + 1.05 * self.radius
        self.scene.set_pose(self.camera, inverse(_GL_FROM_CV @ T_cam_centred))


def _albedo_primitive(gl: Any, mesh: Mesh, vertices: Float[np.ndarray, "v 3"]) -> Any:
    if mesh.texture is not None and mesh.uv is not None:
        # four channels, because OpenGL needs rows of a multiple of four bytes
        opaque = np.dstack([mesh.texture, np.full(mesh.texture.shape[:2], 255, dtype=np.uint8)])
        material = _two_sided(gl, baseColorTexture=gl.Texture(source=opaque, source_channels="RGBA"))
        return gl.Primitive(vertices, indices=mesh.faces, texcoord_0=mesh.uv, material=material)
    plain = np.full((len(vertices), 3), DEFAULT_GREY)
    colours = (plain if mesh.colours is None else mesh.colours) / 255
    opaque = np.concatenate([colours, np.ones((len(vertices), 1))], axis=-1).astype(np.float32)
    return gl.Primitive(vertices, indices=mesh.faces, color_0=opaque, material=_two_sided(gl))


def _two_sided(gl: Any, **textures: Any) -> Any:
    return gl.MetallicRoughnessMaterial(baseColorFactor=(1.0, 1.0, 1.0, 1.0), doubleSided=True, **textures)


@contextmanager
def _open_canvas(mesh: Mesh, crease_deg: float) -> Iterator[_Canvas]:
    """A canvas whose OpenGL context is freed at the end. Raises BadInput where OpenGL is not available."""
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    logging.getLogger("OpenGL").setLevel(logging.WARNING)  # else it logs that its accelerator is missing
    try:
        import pyrender as gl

        canvas = _Canvas(gl, mesh, crease_deg)
    except Exception as error:  # PyOpenGL raises many types for a missing library, driver or device
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        needed = "EGL (apt-get install libegl1 libgl1-mesa-dri), or render=raycast"
        raise BadInput("render=pyrender", found=f"no OpenGL context: {reason}", needed=needed) from None
    try:
        yield canvas
    finally:
        canvas.renderer.delete()
