"""Seconds and peak memory of meshes of 0.1, 1 and 5 million faces: reading, diameter, rendering, simplifying.

Each file is measured in a process of its own. The rendering of 600 views is extrapolated from 20 (OpenGL: 4).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from benchmarks.measure import Measurement, peak_bytes
from pipeline.io.meshes import diameter_mm, read_mesh, write_ply
from pipeline.io.meshes.simplify import simplify_mesh
from pipeline.items.objects import Mesh
from pipeline.parallel import use_threads
from pipeline.stages.render.cameras import RenderSpec
from pipeline.stages.render.pyrender import Pyrender
from pipeline.stages.render.raycast import Raycast

_FACES = (100_000, 1_000_000, 5_000_000)
_ALL_VIEWS, _SIMPLIFIED, _TEXTURE_PX = 600, 200_000, 2048
_VIEWS = {"raycast": 20, "pyrender": 4}
_RENDERERS: dict[str, type[RenderSpec]] = {"raycast": Raycast, "pyrender": Pyrender}
_WAYS = ((".ply", "raycast"), (".glb", "raycast"), (".obj", "raycast"), (".ply", "pyrender"), (".ply", "simplify"))


def meshes(*, device: str, repeats: int) -> list[Measurement]:
    """A scan with a texture as obj, with vertex colours as ply and glb; rendered, or simplified and then rendered."""
    measurements: list[Measurement] = []
    with tempfile.TemporaryDirectory() as name:
        for faces in _FACES:
            paths = {suffix: write_scan(Path(name), faces, suffix) for suffix in (".ply", ".glb", ".obj")}
            for suffix, way in _WAYS:
                command = [sys.executable, "-m", "benchmarks.meshes", str(paths[suffix]), way]
                found = json.loads(subprocess.run(command, check=True, capture_output=True).stdout.splitlines()[-1])
                label = f"{suffix[1:]}, {faces / 1e6:g} million faces, {way}"
                measurements += [Measurement(f"{label}: {what}", *value) for what, value in found.items()]
    return measurements


def write_scan(folder: Path, faces: int, suffix: str) -> Path:
    """A bumpy ball of 200 mm with about so many faces, and a pattern: vertex colours, or a texture for obj."""
    rows = int((faces / 4) ** 0.5)
    mesh = make_scan(rows)
    path = folder / f"scan{suffix}"
    if suffix == ".ply":
        write_ply(path, replace(mesh, uv=None))
    elif suffix == ".glb":
        rgba = np.concatenate([mesh.colours, np.full((len(mesh.vertices), 1), 255, np.uint8)], axis=-1)
        written = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=rgba, process=False).export(file_type="glb")
        assert isinstance(written, bytes)
        path.write_bytes(written)
    else:
        _write_obj(path, mesh)
    return path


def make_scan(rows: int) -> Mesh:
    """A grid of ``rows`` x 2 ``rows`` quads on a ball with bumps, each cut in two."""
    theta, phi = np.meshgrid(
        np.linspace(1e-3, np.pi - 1e-3, rows + 1), np.linspace(0, 2 * np.pi, 2 * rows + 1), indexing="ij"
    )
    radius = 100 + 4 * np.sin(9 * theta) * np.cos(7 * phi) + np.sin(41 * theta) * np.sin(37 * phi)
    unit = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    vertices = (radius[..., None] * unit).reshape(-1, 3)
    corner = (np.arange(rows)[:, None] * (2 * rows + 1) + np.arange(2 * rows)).reshape(-1)
    a, b, c, d = corner, corner + 1, corner + 2 * rows + 2, corner + 2 * rows + 1
    faces = np.concatenate([np.stack([a, d, c], axis=-1), np.stack([a, c, b], axis=-1)])
    uv = np.stack([phi / (2 * np.pi), 1 - theta / np.pi], axis=-1).reshape(-1, 2)
    colours = pattern(uv)
    return Mesh(vertices, faces, colours=colours, uv=uv)


def pattern(uv: np.ndarray) -> np.ndarray:
    """Coloured stripes at texture coordinates, 8 bit."""
    waves = np.stack([np.sin(40 * uv[:, 0]), np.sin(63 * uv[:, 1]), np.cos(31 * uv.sum(axis=-1))], axis=-1)
    return np.rint(127.5 + 127 * waves).astype(np.uint8)


def _write_obj(path: Path, mesh: Mesh) -> None:
    assert mesh.uv is not None
    u, v = np.meshgrid((np.arange(_TEXTURE_PX) + 0.5) / _TEXTURE_PX, 1 - (np.arange(_TEXTURE_PX) + 0.5) / _TEXTURE_PX)
    texture = pattern(np.stack([u, v], axis=-1).reshape(-1, 2)).reshape(_TEXTURE_PX, _TEXTURE_PX, 3)
    Image.fromarray(texture).save(path.with_suffix(".png"))
    path.with_suffix(".mtl").write_text(f"newmtl skin\nmap_Kd {path.stem}.png\n")
    with path.open("w") as stream:
        stream.write(f"mtllib {path.stem}.mtl\nusemtl skin\n")
        for row in range(0, len(mesh.vertices), 1 << 16):
            stream.writelines(
                "v {:.5f} {:.5f} {:.5f}\n".format(*p) for p in mesh.vertices[row : row + (1 << 16)].tolist()
            )
        stream.writelines("vt {:.6f} {:.6f}\n".format(*t) for t in mesh.uv.tolist())
        for row in range(0, len(mesh.faces), 1 << 16):
            corners = np.repeat(mesh.faces[row : row + (1 << 16)] + 1, 2, axis=-1)
            stream.writelines("f {}/{} {}/{} {}/{}\n".format(*f) for f in corners.tolist())


def measure(path: Path, way: str) -> dict[str, tuple[float, str]]:
    """Seconds of all threads and peak memory of one file."""
    found: dict[str, tuple[float, str]] = {}

    def clock(what: str, start: float, factor: float = 1.0) -> None:
        found[what] = (time.process_time() - start) * factor, "s"

    start = time.process_time()
    mesh = read_mesh(path)
    clock("read", start)
    start = time.process_time()
    diameter = diameter_mm(mesh)
    clock("diameter", start)
    start = time.process_time()
    if way == "simplify":
        mesh, note = simplify_mesh(mesh, _SIMPLIFIED, diameter)
        print(note)
    clock("simplify", start)
    kind = "raycast" if way == "simplify" else way
    renderer = _RENDERERS[kind](count=_ALL_VIEWS)
    K, T_cam_obj, size_hw = renderer.cameras(mesh)
    start = time.process_time()
    renderer.render(mesh, K, T_cam_obj[:1], size_hw)
    clock("first view", start)
    start = time.process_time()
    renderer.render(mesh, K, T_cam_obj[: _VIEWS[kind]], size_hw)
    clock(f"{_ALL_VIEWS} views", start, _ALL_VIEWS / _VIEWS[kind])
    found["memory"] = peak_bytes() / 1e9, "GB"
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("mesh", type=Path)
    parser.add_argument("way", choices=[*_RENDERERS, "simplify"])
    args = parser.parse_args()
    use_threads(1)
    print(json.dumps(measure(args.mesh, args.way)))
