"""Mesh files -> meshes in millimetres: the only door to trimesh's loaders.

Numbers are taken as they stand, as millimetres, whatever unit a format prescribes. Files beside a mesh (materials,
textures) must lie in its folder or below, links resolved; nothing else is opened, fetched or unpickled.
"""

from __future__ import annotations

import io
import json
import logging
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float, Int, Num, UInt8
from PIL import Image

from pipeline.errors import BadInput
from pipeline.io.digests import files_digest
from pipeline.io.files import IMAGE_FORMATS, read_file
from pipeline.items.objects import Mesh

if TYPE_CHECKING:
    from trimesh import Trimesh

SUFFIXES = (".ply", ".obj", ".glb", ".gltf", ".stl", ".off")
_PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".tga", ".webp", ".gif", ".ppm")
_MAX_TEXTURE_PX = 16384
_MAX_NAME = 255
_MAX_FACES = 20_000_000
_MAX_UNSTORED = 1_000_000  # elements of a glTF accessor that no buffer holds: they cost the file nothing
_READABLE = "a readable mesh file"
_GUTTER = 8  # texels around a texture in an atlas: enough for a minification by 8


def read_mesh(path: Path) -> Mesh:
    """The triangles of a .ply, .obj, .glb, .gltf, .stl or .off file, several geometries as one.

    A ply's vertices keep their order; where one has several texture coordinates or colours, copies follow after the
    last. Other formats keep the vertices that faces use, copies beside them. Raises BadInput for a file or companion
    that is missing or broken, and for a mesh without an extent.
    """
    path = _mesh_file(path)
    companions = _Companions(path)
    mesh = _checked(path, _load(path, companions))
    return replace(mesh, digest=companions.digest())


def mesh_digest(path: Path) -> str:
    """``read_mesh(path).digest``, from the header alone where the format is ply. Raises BadInput as that does."""
    path = _mesh_file(path)
    if path.suffix.lower() != ".ply":
        return read_mesh(path).digest  # which files belong to it is known once it has been read
    companions = _Companions(path)
    name = _texture_name(_ply_head(path, read_file(path, _READABLE)))
    if name is not None:
        companions.read(name)
    return companions.digest()


def _mesh_file(path: Path) -> Path:
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise BadInput(path, found=f"suffix {path.suffix!r}", needed=f"a mesh: {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise BadInput(path, found="no such file", needed="a mesh file")
    return path


def write_ply(path: Path, mesh: Mesh) -> None:
    """Vertices (float32), colours if any and faces as binary ply; a texture is not written."""
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


def diameter_mm(mesh: Mesh) -> float:
    """Largest distance between two vertices, exact: both lie on the convex hull."""
    from scipy.spatial import ConvexHull, QhullError
    from scipy.spatial.distance import cdist

    points = np.unique(mesh.vertices, axis=0)
    with suppress(QhullError):  # a flat mesh has no hull in space: all pairs are compared
        points = points[ConvexHull(points).vertices]
    reach = np.linalg.norm(points - (points.min(axis=0) + points.max(axis=0)) / 2, axis=-1)
    largest = float(cdist(points[[reach.argmax()]], points).max())
    # the two ends of a longer distance reach at least this far, by the triangle inequality
    points = points[reach >= (largest - reach.max()) * (1 - 1e-9)]
    for row in range(0, len(points), 512):  # 512 rows at a time: a sphere's vertices are all left
        largest = max(largest, float(cdist(points[row : row + 512], points).max()))
    return largest


class _Companions:
    """Files named inside a mesh file: read from its folder alone, remembered for the digest.

    trimesh swallows what goes wrong in here; ``failure`` keeps it.
    """

    def __init__(self, mesh_path: Path) -> None:
        self.mesh_path = mesh_path
        self.file_name = mesh_path.name
        self.opened: dict[str, Path] = {}
        self.failure: BadInput | None = None

    def get(self, name: str) -> bytes:
        """Bytes of the file ``name``. Raises BadInput, and keeps it."""
        try:
            path, data = self.read(name)
            if path.suffix.lower() in _PICTURES:
                _picture(path, data)
        except BadInput as error:
            self.failure = self.failure or error
            raise
        return data

    __getitem__ = get

    def read(self, name: str) -> tuple[Path, bytes]:
        """Path and bytes of the file ``name``, whatever it holds; it is remembered. Raises BadInput."""
        relative = self._inside(name)
        path = self.mesh_path.parent / relative
        data = read_file(path, f"the file named in {self.mesh_path.name}")
        self.opened[relative.as_posix()] = path
        return path, data

    def digest(self) -> str:
        """Of the mesh file and all that was opened beside it."""
        return files_digest({self.mesh_path.name: self.mesh_path} | self.opened)

    def _inside(self, name: str) -> PurePosixPath:
        relative = PurePosixPath(name.strip().strip('"').replace("\\", "/"))
        if "\0" in name or len(name) > _MAX_NAME:
            raise BadInput(self.mesh_path, found=f"a reference to {name[:40]!r}...", needed="the name of a file")
        if not (self.mesh_path.parent / relative).is_file():
            relative = PurePosixPath(unquote(str(relative)))  # glTF writes a blank as %20
        outside = relative.is_absolute() or ".." in relative.parts or ":" in str(relative) or str(relative) == "."
        if outside or self._linked_out(relative):
            raise BadInput(self.mesh_path, found=f"a reference to {name!r}", needed="a file in the mesh's own folder")
        return relative

    def _linked_out(self, relative: PurePosixPath) -> bool:
        folder = self.mesh_path.parent
        return not (folder / relative).resolve().is_relative_to(folder.resolve())


def _picture(path: Path, data: bytes) -> UInt8[np.ndarray, "H W 3"]:
    try:
        with Image.open(io.BytesIO(data), formats=IMAGE_FORMATS) as image:
            return np.asarray(image.convert("RGB"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        found = "not an image" if isinstance(error, Image.UnidentifiedImageError) else error
        raise BadInput(path, found=found, needed="a readable texture image") from None


def _load(path: Path, companions: _Companions) -> Mesh:
    data = read_file(path, _READABLE)
    try:
        with _quiet_trimesh():
            if path.suffix.lower() == ".ply":
                return _from_ply(path, data, companions)
            mesh = _from_scene(path, data, companions)
    except BadInput:
        raise
    except Exception as error:  # trimesh's parsers raise whatever numpy, struct or json does on broken bytes
        if companions.failure is None:
            reason = (str(error).splitlines() or [""])[0][:120]
            found = f"unreadable content ({type(error).__name__}: {reason})"
            raise BadInput(path, found=found, needed=f"a whole {path.suffix.lower()} file") from None
    if companions.failure is not None:
        raise companions.failure
    return mesh


@contextmanager
def _quiet_trimesh() -> Iterator[None]:
    """What trimesh would log of a broken file, tracebacks included, is answered by a BadInput instead."""
    logger = logging.getLogger("trimesh")
    before, logger.disabled = logger.disabled, True
    try:
        yield
    finally:
        logger.disabled = before


def _from_ply(path: Path, data: bytes, companions: _Companions) -> Mesh:
    """A ply, from trimesh's parse of its elements: its own conversion reorders vertices and forgets colours."""
    from trimesh.exchange.ply import load_ply

    head = _ply_head(path, data)
    parsed = load_ply(io.BytesIO(data), skip_materials=True, fix_texture=False)
    raw = parsed["metadata"]["_ply_raw"]
    for name in ("vertex", "face"):
        if not raw.get(name, {}).get("length"):
            raise BadInput(path, found=f"0 elements {name!r}", needed="a mesh with vertices and faces")
    vertices, faces = np.asarray(parsed["vertices"], dtype=float), _triangles(parsed["faces"])
    if len(vertices) < raw["vertex"]["length"] or len(faces) < raw["face"]["length"]:
        found = f"{len(vertices)} vertices and {len(faces)} faces"
        declared = f"{raw['vertex']['length']} and {raw['face']['length']}"
        raise BadInput(path, found=found, needed=f"the {declared} that its header declares")
    mesh = Mesh(vertices, faces, colours=_columns(raw["vertex"], ("red", "green", "blue"), np.uint8))
    if (texture := _texture_name(head)) is not None:
        return _ply_texture(path, mesh, raw, texture, companions)
    face_colours = _columns(raw["face"], ("red", "green", "blue"), np.uint8)
    if mesh.colours is None and face_colours is not None and len(face_colours) == len(faces):
        return _split_colours(mesh, face_colours)
    return mesh


def _ply_head(path: Path, data: bytes) -> bytes:
    """The header of a ply, from the file's first bytes."""
    head, end, _ = data[: 1 << 16].partition(b"end_header")
    if not head.startswith(b"ply") or not end:
        raise BadInput(path, found="no ply header", needed="a whole .ply file")
    return head


def _texture_name(head: bytes) -> str | None:
    named = re.search(rb"comment\s+TextureFile\s+(.+)", head, flags=re.IGNORECASE)
    return None if named is None else named[1].decode(errors="replace").strip()


def _ply_texture(path: Path, mesh: Mesh, raw: dict[str, Any], name: str, companions: _Companions) -> Mesh:
    """The mesh with texture ``name``; coordinates by vertex (BOP) or by corner (MeshLab)."""
    data = companions.get(name)
    texture = _picture(path.parent / name, data)
    corner_uv = _columns(raw["face"], ("texcoord",), float)
    if corner_uv is not None:
        if corner_uv.size != mesh.faces.size * 2:
            found = f"{corner_uv.size} numbers in 'texcoord' for {len(mesh.faces)} triangles"
            raise BadInput(path, found=found, needed="2 per corner of a triangle")
        vertices, faces, uv = _split(mesh.vertices, mesh.faces, corner_uv.reshape(-1, 3, 2))
        return Mesh(vertices, faces, uv=uv, texture=texture)
    for names in (("texture_u", "texture_v"), ("u", "v"), ("s", "t")):
        vertex_uv = _columns(raw["vertex"], names, float)
        if vertex_uv is not None:
            return replace(mesh, colours=None, uv=vertex_uv, texture=texture)
    raise BadInput(path, found=f"a texture {name!r} without coordinates", needed="texture_u, texture_v or texcoord")


def _columns(element: dict[str, Any], names: Sequence[str], dtype: type) -> Num[np.ndarray, "n c"] | None:
    """Properties of a ply element side by side, None if one is absent. Colours in 0..1 become 0..255."""
    if any(name not in element["properties"] for name in names):
        return None
    blob = element["data"]
    rows = [blob[name]["f1"] if getattr(blob[name].dtype, "names", None) else blob[name] for name in names]
    table = np.concatenate([np.asarray(row).reshape(element["length"], -1) for row in rows], axis=1)
    if dtype is np.uint8 and table.dtype.kind == "f":
        table = np.rint(np.clip(table, 0, 1) * 255)
    return table.astype(dtype)


def _triangles(faces: Any) -> Int[np.ndarray, "f 3"]:
    from trimesh.geometry import triangulate_quads

    if isinstance(faces, np.ndarray) and faces.ndim == 2 and faces.shape[1] == 3:
        return faces.astype(np.int64)
    return np.asarray(triangulate_quads(faces), dtype=np.int64).reshape(-1, 3)


def _from_scene(path: Path, data: bytes, companions: _Companions) -> Mesh:
    """Every geometry of an obj, gltf, stl or off file where its scene places it."""
    import trimesh

    if path.suffix.lower() in (".gltf", ".glb"):
        _check_accessors(path, data)
    resolver: Any = companions  # get() is all that trimesh asks of one
    scene = trimesh.load_scene(
        io.BytesIO(data),
        file_type=path.suffix.lower().removeprefix("."),
        resolver=resolver,
        process=False,  # and not maintain_order, which gives a vertex on a seam one of its coordinates at random
    )
    parts = []
    faces = sum(len(getattr(scene.geometry[scene.graph[node][1]], "faces", ())) for node in scene.graph.nodes_geometry)
    if faces > _MAX_FACES:
        raise BadInput(path, found=f"{faces} faces, copies counted", needed=f"at most {_MAX_FACES}")
    for node in scene.graph.nodes_geometry:
        T_scene_part, name = scene.graph[node]
        geometry = scene.geometry[name]
        if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces):
            part = _part(path, geometry)
            parts.append(replace(part, vertices=part.vertices @ T_scene_part[:3, :3].T + T_scene_part[:3, 3]))
    if not parts:
        raise BadInput(path, found="0 faces", needed="a mesh with vertices and faces")
    return parts[0] if len(parts) == 1 else _joined(path, parts)


def _check_accessors(path: Path, data: bytes) -> None:
    """Raise BadInput where a glTF asks for memory that its buffers do not fill."""
    text = data[20 : 20 + int.from_bytes(data[12:16], "little")] if data[:4] == b"glTF" else data
    for accessor in json.loads(text).get("accessors", []):
        if "bufferView" not in accessor and accessor["count"] > _MAX_UNSTORED:
            found = f"an accessor of {accessor['count']} elements without a buffer"
            raise BadInput(path, found=found, needed=f"at most {_MAX_UNSTORED}")


def _part(path: Path, geometry: Trimesh) -> Mesh:
    """One trimesh geometry: its texture, else its colours, else the colour of its material, else plain."""
    mesh = Mesh(np.asarray(geometry.vertices, dtype=float), np.asarray(geometry.faces, dtype=np.int64))
    _check_indices(path, mesh)
    visual: Any = geometry.visual
    if visual.kind == "vertex":
        return replace(mesh, colours=np.asarray(visual.vertex_colors[:, :3], dtype=np.uint8))
    if visual.kind == "face":
        return _split_colours(mesh, np.asarray(visual.face_colors[:, :3], dtype=np.uint8))
    if visual.kind != "texture":
        return mesh
    material = visual.material
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if image is not None and visual.uv is not None:
        if image.format not in (None, "MPO", *IMAGE_FORMATS):  # None: made by trimesh; MPO: a kind of JPEG
            raise BadInput(path, found=f"a texture in {image.format}", needed=f"one of {', '.join(IMAGE_FORMATS)}")
        texture = np.asarray(image.convert("RGB"))
        factor = getattr(material, "baseColorFactor", None)
        if factor is not None:
            texture = np.rint(texture * (np.asarray(factor[:3]) / 255)).astype(np.uint8)
        return replace(mesh, uv=np.asarray(visual.uv, dtype=float), texture=texture)
    colour = np.asarray(material.main_color[:3], dtype=np.uint8)
    return replace(mesh, colours=np.tile(colour, (len(mesh.vertices), 1)))


def _split_colours(mesh: Mesh, face_colours: UInt8[np.ndarray, "f 3"]) -> Mesh:
    corners = np.repeat(face_colours[:, None].astype(float), 3, axis=1)
    vertices, faces, colours = _split(mesh.vertices, mesh.faces, corners)
    return Mesh(vertices, faces, colours=colours.astype(np.uint8))


def _split(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], corners: Float[np.ndarray, "f 3 k"]
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "f 3"], Float[np.ndarray, "w k"]]:
    """Values of corners as values of vertices: a vertex with several of them gets copies after the last vertex."""
    if faces.min() < 0 or faces.max() >= len(vertices):
        return vertices, faces, np.zeros((len(vertices), corners.shape[-1]))  # refused by the check that follows
    rows = np.concatenate([faces.reshape(-1, 1), corners.reshape(len(faces) * 3, -1)], axis=1)
    unique, inverse = np.unique(rows, axis=0, return_inverse=True)
    owner = unique[:, 0].astype(np.int64)
    copy = np.concatenate([[False], owner[1:] == owner[:-1]])
    index = np.where(copy, len(vertices) + np.cumsum(copy) - 1, owner)
    values = np.zeros((len(vertices) + int(copy.sum()), corners.shape[-1]))
    values[index] = unique[:, 1:]
    return np.concatenate([vertices, vertices[owner[copy]]]), index[inverse.reshape(faces.shape)], values


def _joined(path: Path, parts: Sequence[Mesh]) -> Mesh:
    """Several parts as one mesh: their textures in one atlas, plain colours as single texels beside them."""
    if any(part.texture is not None for part in parts):
        parts = _atlas(path, [part if part.texture is not None else _palette(part) for part in parts])
    elif any(part.colours is not None for part in parts):
        parts = [part if part.colours is not None else replace(part, colours=_grey(part)) for part in parts]
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])

    def stacked(field: str) -> Any:
        values = [getattr(part, field) for part in parts]
        return None if values[0] is None else np.concatenate(values)

    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)]),
        colours=stacked("colours"),
        uv=stacked("uv"),
        texture=parts[0].texture,
    )


def _grey(part: Mesh) -> UInt8[np.ndarray, "v 3"]:
    from pipeline.functional.shading import DEFAULT_GREY

    return np.full((len(part.vertices), 3), DEFAULT_GREY, dtype=np.uint8)


def _palette(part: Mesh) -> Mesh:
    """A coloured part as a textured one: each face takes the texel of its mean colour."""
    colours = _grey(part) if part.colours is None else part.colours
    mean = np.rint(colours[part.faces].mean(axis=1)).astype(np.uint8)
    palette, which = np.unique(mean, axis=0, return_inverse=True)
    side = int(np.ceil(len(palette) ** 0.5))
    texture = np.zeros((side * side, 3), dtype=np.uint8)
    texture[: len(palette)] = palette
    row, column = np.divmod(which.reshape(-1), side)
    uv = np.stack([(column + 0.5) / side, 1 - (row + 0.5) / side], axis=-1)
    vertices, faces, uv = _split(part.vertices, part.faces, np.repeat(uv[:, None], 3, axis=1))
    return Mesh(vertices, faces, uv=uv, texture=texture.reshape(side, side, 3))


def _atlas(path: Path, parts: Sequence[Mesh]) -> list[Mesh]:
    """The parts with one texture in common: theirs on top of one another, repeats written out."""
    tiled = [_tiled(path, part) for part in parts]
    # each texture goes on for some texels, as its repeat would, so that neighbours do not bleed into it
    framed = [np.pad(texture, ((_GUTTER, _GUTTER), (_GUTTER, _GUTTER), (0, 0)), mode="wrap") for _, texture in tiled]
    height, width = sum(texture.shape[0] for texture in framed), max(texture.shape[1] for texture in framed)
    if max(height, width) > _MAX_TEXTURE_PX:
        found = f"textures that make an atlas of {width} x {height}"
        raise BadInput(path, found=found, needed=f"at most {_MAX_TEXTURE_PX} pixels a side; bake them into one")
    atlas = np.zeros((height, width, 3), dtype=np.uint8)
    placed, top = [], 0
    for part, frame, (uv, texture) in zip(parts, framed, tiled, strict=True):
        h, w = texture.shape[:2]
        atlas[top : top + len(frame), : frame.shape[1]] = frame
        x, y = _GUTTER + uv[:, 0] * w, top + _GUTTER + (1 - uv[:, 1]) * h
        placed.append(replace(part, uv=np.stack([x / width, 1 - y / height], axis=-1), texture=atlas))
        top += len(frame)
    return placed


def _tiled(path: Path, part: Mesh) -> tuple[Float[np.ndarray, "v 2"], UInt8[np.ndarray, "H W 3"]]:
    """Coordinates within 0..1 and the texture repeated as often as the part's coordinates did."""
    assert part.uv is not None
    assert part.texture is not None
    if not np.isfinite(part.uv).all():
        raise BadInput(path, found="a texture coordinate that is not a number", needed="finite coordinates")
    low = np.floor(part.uv.min(axis=0) + 1e-6)
    times = np.maximum(np.ceil(part.uv.max(axis=0) - 1e-6) - low, 1)
    if (times[::-1] * part.texture.shape[:2]).max() > _MAX_TEXTURE_PX:
        found = f"a texture repeated {times[0]:.0f} x {times[1]:.0f} times"
        raise BadInput(path, found=found, needed="one texture without repeats; bake it")
    return (part.uv - low) / times, np.tile(part.texture, (int(times[1]), int(times[0]), 1))


def _checked(path: Path, mesh: Mesh) -> Mesh:
    """The mesh itself. Raises BadInput for one that cannot be rendered or measured."""
    _check_indices(path, mesh)
    wrong = np.flatnonzero(~np.isfinite(mesh.vertices).all(axis=1))
    if len(wrong):
        found = f"vertex {wrong[0]} at {mesh.vertices[wrong[0]].tolist()}"
        raise BadInput(path, found=found, needed="finite coordinates in mm")
    if not np.ptp(mesh.vertices, axis=0).any():
        raise BadInput(path, found="all vertices in one point", needed="a mesh with an extent, in mm")
    if mesh.uv is not None and not np.isfinite(mesh.uv).all():
        raise BadInput(path, found="a texture coordinate that is not a number", needed="finite coordinates")
    return mesh


def _check_indices(path: Path, mesh: Mesh) -> None:
    if not len(mesh.vertices) or not len(mesh.faces):
        found = f"{len(mesh.vertices)} vertices and {len(mesh.faces)} faces"
        raise BadInput(path, found=found, needed="a mesh with vertices and faces")
    low, high = int(mesh.faces.min()), int(mesh.faces.max())
    if low < 0 or high >= len(mesh.vertices):
        found = f"a face with vertex {low if low < 0 else high}"
        raise BadInput(path, found=found, needed=f"indices from 0 to {len(mesh.vertices) - 1}")
