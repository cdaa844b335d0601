"""ply files: parsing with BOP's and MeshLab's texture coordinates, and writing."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.errors import BadInput
from pipeline.io.meshes.atlas import join_meshes
from pipeline.io.meshes.checks import check_indices
from pipeline.io.meshes.colours import to_uint8
from pipeline.io.meshes.companions import Companions
from pipeline.io.meshes.corners import select_faces, split_face_colours, split_vertices
from pipeline.io.meshes.ply_table import Columns, Header, read_columns, read_header
from pipeline.io.meshes.polygons import Ragged, triangulate
from pipeline.items.objects import Mesh

_UV_NAMES = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"), ("texture_s", "texture_t"))
_UNSEEN = ("specular", "ambient", "emissi")  # reflections and light: not the colour of the surface


@dataclass(frozen=True)
class Surface:
    """A ply without its textures. ``corners``: index of each triangle's corners in the lists of ``polygons``.

    ``revised``: whether version 1 of this reader gave another mesh, so that the digest must differ.
    """

    header: Header
    vertex: Columns
    face: Columns
    mesh: Mesh
    polygons: Ragged
    corners: Int[np.ndarray, "f 3"]
    revised: bool

    @property
    def polygon(self) -> Int[np.ndarray, " f"]:
        """Polygon index of each triangle."""
        return np.searchsorted(self.polygons.starts, self.corners[:, 0], side="right") - 1


def parse_ply(path: Path, data: bytes, companions: Companions) -> tuple[Mesh, bool]:
    """The mesh in a ply's bytes, not checked yet, and whether version 1 gave another one. Raises BadInput."""
    surface = read_surface(path, data)
    textures = [companions.texture(name) for name in surface.header.textures]
    if not textures:
        return surface.mesh, surface.revised
    if len(textures) == 1:
        return _add_texture(path, surface, textures[0]), surface.revised
    number = surface.face.get("texnumber", surface.face.get("texture_number"))
    if not isinstance(number, np.ndarray):
        found = f"{len(textures)} textures, and faces without 'texnumber'"
        raise BadInput(path, found=found, needed="one texture, or each face's number of its own")
    whole, number = _add_texture(path, surface, textures[0]), number[surface.polygon]
    if number.max() >= len(textures):
        raise BadInput(path, found=f"texnumber {number.max():g}", needed=f"numbers below {len(textures)}")
    plain = replace(surface.mesh, warnings=())
    parts = [
        select_faces(replace(whole, texture=texture), np.flatnonzero(number == k)) for k, texture in enumerate(textures)
    ]
    parts.append(select_faces(plain, np.flatnonzero(number < 0)))
    return join_meshes(path, [part for part in parts if len(part.faces)]), surface.revised


def read_surface(path: Path, data: bytes) -> Surface:
    """Triangles and colours in a ply's bytes, without opening other files. Raises BadInput."""
    header = read_header(path, data)
    lengths = {element.name: element.length for element in header.elements}
    if lengths.get("tristrips") and not lengths.get("face"):
        raise BadInput(path, found="triangle strips ('tristrips')", needed="faces; export it as triangles")
    for name in ("vertex", "face"):
        if not lengths.get(name):
            raise BadInput(path, found=f"0 elements {name!r}", needed="a mesh with vertices and faces")
    tables = read_columns(path, data, header)
    vertex, face = tables["vertex"], tables["face"]
    vertices = _numbers(path, vertex, "xyz")
    polygons = _polygons(path, face)
    corners, cut = triangulate(vertices, polygons)
    mesh = Mesh(vertices, polygons.values[corners].astype(np.int64))
    check_indices(path, mesh)
    surface = Surface(header, vertex, face, mesh, polygons, corners, cut or len(header.textures) > 1)
    return surface if header.textures and len(header.textures) == 1 else _add_colours(path, surface)


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


def _numbers(path: Path, columns: Columns, names: Iterable[str]) -> Float[np.ndarray, "n k"]:
    missing = [name for name in names if not isinstance(columns.get(name), np.ndarray)]
    if missing:
        raise BadInput(path, found=f"vertices without {', '.join(missing)}", needed="x, y and z")
    return np.stack([np.asarray(columns[name], dtype=float) for name in names], axis=-1)


def _polygons(path: Path, face: Columns) -> Ragged:
    """The vertices of each face."""
    lists = {name: column for name, column in face.items() if isinstance(column, Ragged)}
    named = [lists[name] for name in ("vertex_indices", "vertex_index") if name in lists]
    if not named and len(lists) != 1:
        raise BadInput(path, found=f"faces of {', '.join(face)}", needed="a list 'vertex_indices'")
    return (named or list(lists.values()))[0]


def _add_colours(path: Path, surface: Surface) -> Surface:
    """The surface with vertex colours, or else face colours."""
    colours, revised = _colours(path, surface.vertex)
    if colours is not None:
        mesh = replace(surface.mesh, colours=colours)
        return replace(surface, mesh=mesh, revised=surface.revised or revised)
    colours, revised = _colours(path, surface.face)
    if colours is not None:
        has_polygons = len(surface.corners) != len(surface.polygons.counts)
        mesh = split_face_colours(surface.mesh, colours[surface.polygon])
        return replace(surface, mesh=mesh, revised=surface.revised or revised or has_polygons)
    stated = [
        n
        for n in (*surface.vertex, *surface.face)
        if re.search("colou?r|rgb|red|green|blue|gr[ae]y|intensity", n.lower())
    ]
    if not stated:
        return surface
    warning = f"its properties {', '.join(stated)} are not read as colours; red, green and blue are"
    return replace(surface, mesh=replace(surface.mesh, warnings=(warning,)))


def _colours(path: Path, columns: Columns) -> tuple[UInt8[np.ndarray, "n 3"] | None, bool]:
    """Colours, None if there are none, and whether version 1 read them differently."""
    names = _colour_names([name for name, column in columns.items() if isinstance(column, np.ndarray)])
    if names is None:
        return None, False
    table = np.stack([np.asarray(columns[name]) for name in names], axis=-1)
    limit = 1 if table.dtype.kind == "f" else 255
    return to_uint8(path, table), names != ("red", "green", "blue") or bool(table.max(initial=0) > limit)


def _colour_names(names: Sequence[str]) -> tuple[str, ...] | None:
    """Names of the three properties of a colour: red, diffuse_red or r and the like; None without them."""
    by_lower = {name.lower(): name for name in names}
    found: dict[str, tuple[str, ...]] = {}
    for name in by_lower:
        prefix = name.removesuffix("red") if name.endswith("red") else ""
        ends = ("r", "g", "b") if name == "r" else ("red", "green", "blue")
        triple = tuple(by_lower.get(prefix + end, "") for end in ends)
        if name == prefix + ends[0] and all(triple) and not prefix.startswith(_UNSEEN):
            found[name] = triple
    best = sorted(found, key=lambda red: (red != "red", "diffuse" not in red, len(red)))
    return found[best[0]] if best else None


def _add_texture(path: Path, surface: Surface, texture: UInt8[np.ndarray, "H W 3"]) -> Mesh:
    """The mesh with a texture; its coordinates are stored by vertex (BOP) or by corner (MeshLab)."""
    mesh, corner_uv = surface.mesh, surface.face.get("texcoord")
    if isinstance(corner_uv, Ragged):
        if len(corner_uv.values) != 2 * len(surface.polygons.values):
            found = f"{len(corner_uv.values)} numbers in 'texcoord' for {len(surface.polygons.values)} corners"
            raise BadInput(path, found=found, needed="2 per corner of a face")
        by_corner = corner_uv.values.reshape(-1, 2).astype(float)[surface.corners]
        vertices, faces, uv = split_vertices(mesh.vertices, mesh.faces, by_corner)
        return Mesh(vertices, faces, uv=uv, texture=texture)
    for names in _UV_NAMES:
        if all(isinstance(surface.vertex.get(name), np.ndarray) for name in names):
            return replace(mesh, colours=None, uv=_numbers(path, surface.vertex, names), texture=texture)
    found = f"a texture {surface.header.textures[0]!r} without coordinates"
    raise BadInput(path, found=found, needed="texture_u, texture_v or texcoord")
