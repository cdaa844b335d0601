"""ply files: parsing with BOP's and MeshLab's texture coordinates, and writing."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int, Num

from pipeline.errors import BadInput
from pipeline.io.meshes.companions import Companions, decode_texture
from pipeline.io.meshes.corners import split_face_colours, split_vertices
from pipeline.items.objects import Mesh


def parse_ply(path: Path, data: bytes, companions: Companions) -> Mesh:
    """The mesh in a ply's bytes, not checked yet. Raises BadInput.

    Built from the elements that trimesh parses; trimesh's own conversion reorders vertices and drops colours.
    """
    from trimesh.exchange.ply import load_ply

    header = read_header(path, data)
    parsed = load_ply(io.BytesIO(data), skip_materials=True, fix_texture=False)
    elements = parsed["metadata"]["_ply_raw"]
    for name in ("vertex", "face"):
        if not elements.get(name, {}).get("length"):
            raise BadInput(path, found=f"0 elements {name!r}", needed="a mesh with vertices and faces")
    vertices, faces = np.asarray(parsed["vertices"], dtype=float), _triangulate(parsed["faces"])
    if len(vertices) < elements["vertex"]["length"] or len(faces) < elements["face"]["length"]:
        found = f"{len(vertices)} vertices and {len(faces)} faces"
        declared = f"{elements['vertex']['length']} and {elements['face']['length']}"
        raise BadInput(path, found=found, needed=f"the {declared} that its header declares")
    mesh = Mesh(vertices, faces, colours=_columns(elements["vertex"], ("red", "green", "blue"), np.uint8))
    if (texture := texture_name(header)) is not None:
        return _add_texture(path, mesh, elements, texture, companions)
    face_colours = _columns(elements["face"], ("red", "green", "blue"), np.uint8)
    if mesh.colours is None and face_colours is not None and len(face_colours) == len(faces):
        return split_face_colours(mesh, face_colours)
    return mesh


def read_header(path: Path, data: bytes) -> bytes:
    """A ply's header, without ``end_header``. Raises BadInput."""
    header, end, _ = data[: 1 << 16].partition(b"end_header")
    if not header.startswith(b"ply") or not end:
        raise BadInput(path, found="no ply header", needed="a complete .ply file")
    return header


def texture_name(header: bytes) -> str | None:
    """File name in the header's ``comment TextureFile``, None without one."""
    found = re.search(rb"comment\s+TextureFile\s+(.+)", header, flags=re.IGNORECASE)
    return None if found is None else found[1].decode(errors="replace").strip()


def write_ply(path: Path, mesh: Mesh) -> None:
    """Write vertices (float32), vertex colours if any, and faces as binary ply; a texture is not written."""
    fields: list[Any] = [("xyz", "<f4", 3)] + ([] if mesh.colours is None else [("rgb", "u1", 3)])
    vertices = np.empty(len(mesh.vertices), dtype=fields)
    vertices["xyz"] = mesh.vertices
    if mesh.colours is not None:
        vertices["rgb"] = mesh.colours
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    faces["count"], faces["index"] = 3, mesh.faces
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    header += [f"property uchar {name}" for name in ("red", "green", "blue") if mesh.colours is not None]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header\n"]
    path.write_bytes("\n".join(header).encode() + vertices.tobytes() + faces.tobytes())


def _add_texture(path: Path, mesh: Mesh, elements: dict[str, Any], name: str, companions: Companions) -> Mesh:
    """The mesh with texture ``name``; its coordinates are stored by vertex (BOP) or by corner (MeshLab)."""
    data = companions.get(name)
    texture = decode_texture(path.parent / name, data)
    corner_uv = _columns(elements["face"], ("texcoord",), float)
    if corner_uv is not None:
        if corner_uv.size != mesh.faces.size * 2:
            found = f"{corner_uv.size} numbers in 'texcoord' for {len(mesh.faces)} triangles"
            raise BadInput(path, found=found, needed="2 per corner of a triangle")
        vertices, faces, uv = split_vertices(mesh.vertices, mesh.faces, corner_uv.reshape(-1, 3, 2))
        return Mesh(vertices, faces, uv=uv, texture=texture)
    for names in (("texture_u", "texture_v"), ("u", "v"), ("s", "t")):
        vertex_uv = _columns(elements["vertex"], names, float)
        if vertex_uv is not None:
            return replace(mesh, colours=None, uv=vertex_uv, texture=texture)
    raise BadInput(path, found=f"a texture {name!r} without coordinates", needed="texture_u, texture_v or texcoord")


def _columns(element: dict[str, Any], names: Sequence[str], dtype: type) -> Num[np.ndarray, "n c"] | None:
    """Properties of a ply element as columns, None if one is absent. Float colours (0..1) become 0..255."""
    if any(name not in element["properties"] for name in names):
        return None
    data = element["data"]
    # trimesh stores a list property as a structured array whose field f1 holds the values
    columns = [data[name]["f1"] if getattr(data[name].dtype, "names", None) else data[name] for name in names]
    table = np.concatenate([np.asarray(column).reshape(element["length"], -1) for column in columns], axis=1)
    if dtype is np.uint8 and table.dtype.kind == "f":
        table = np.rint(np.clip(table, 0, 1) * 255)
    return table.astype(dtype)


def _triangulate(faces: Any) -> Int[np.ndarray, "f 3"]:
    from trimesh.geometry import triangulate_quads

    if isinstance(faces, np.ndarray) and faces.ndim == 2 and faces.shape[1] == 3:
        return faces.astype(np.int64)
    return np.asarray(triangulate_quads(faces), dtype=np.int64).reshape(-1, 3)
