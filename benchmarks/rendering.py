"""Views per second of render=raycast compared with bare embree casting the same rays, 2 x 2 per pixel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from benchmarks.measure import Measurement, time_interleaved
from pipeline.functional.camera import unproject
from pipeline.items.objects import Mesh
from pipeline.stages.render.cameras import bounding_sphere, subpixels
from pipeline.stages.render.ray_mesh import _import_embree
from pipeline.stages.render.raycast import Raycast
from pipeline.synthetic.objects import make_object

_VIEWS = 10
_TEXTURE_PX = 1024


def rendering(*, device: str, repeats: int) -> list[Measurement]:
    """Views per second of 256 px templates of coloured, textured and plain meshes."""
    coloured = make_object(1)
    meshes = {"colours": coloured, "a texture": add_texture(coloured), "neither": replace(coloured, colours=None)}
    renderer = Raycast(count=_VIEWS, supersample=2)
    candidates: dict[str, Callable[[], object]] = {}
    for name, mesh in meshes.items():
        K, T_cam_obj, size_hw = renderer.cameras(mesh)
        candidates[name] = lambda mesh=mesh, K=K, T=T_cam_obj, hw=size_hw: renderer.render(mesh, K, T, hw)  # type: ignore[misc]
    candidates["embree"] = bare_embree(coloured, *renderer.cameras(coloured))
    times = time_interleaved(candidates, repeats=repeats)
    alone = times["embree"].cpu_s
    measurements = [
        Measurement("views of bare embree, 2 x 2 rays per pixel of the box", _VIEWS / alone, "views/s of one core")
    ]
    for name in meshes:
        measurements += [
            Measurement(f"views of a mesh with {name}, 2 x 2", _VIEWS / times[name].cpu_s, "views/s of one core"),
            Measurement(
                f"views of a mesh with {name}, 2 x 2", 100 * alone / times[name].cpu_s, "%", "bare embree", 50.0, "more"
            ),
        ]
    return measurements


def add_texture(mesh: Mesh) -> Mesh:
    """The mesh with a noise texture, projected along one axis."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    uv = ((mesh.vertices - low) / (high - low))[:, :2]
    texture = np.random.default_rng(0).integers(0, 256, (_TEXTURE_PX, _TEXTURE_PX, 3), dtype=np.uint8)
    return replace(mesh, colours=None, uv=uv, texture=texture)


def bare_embree(mesh: Mesh, K: np.ndarray, T_cam_obj: np.ndarray, size_hw: tuple[int, int]) -> Callable[[], object]:
    """Casts precomputed rays, four per pixel of the object's bounding box, without shading."""
    scene, triangles = _import_embree()
    built = scene(robust=True)
    centre, _ = bounding_sphere(mesh)
    geometry = triangles(built, (mesh.vertices - centre).astype(np.float32), mesh.faces.astype(np.int32))
    rays = []
    for T in T_cam_obj:
        R, t = T[:3, :3], T[:3, 3]
        points = mesh.vertices @ R.T + t
        px = points @ K.T
        px = px[:, :2] / px[:, 2:]
        low, high = np.floor(px.min(axis=0)), np.ceil(px.max(axis=0))
        grid = np.stack(np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1)), axis=-1)
        fine = (grid.reshape(-1, 1, 2) + subpixels(2)).reshape(-1, 2)
        direction = (unproject(K, fine, np.ones(len(fine))) @ R).astype(np.float32)
        start = (points[:, 2].min() * 0.99 * direction - (R.T @ t + centre)).astype(np.float32)
        rays.append((start, direction))
    return lambda: (geometry, [built.run(start, direction, output=1) for start, direction in rays])
