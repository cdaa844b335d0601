"""obj files, parsed column-wise with NumPy: a loop over the lines of a scan would take minutes."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.errors import BadInput
from pipeline.functional.shading import DEFAULT_GREY
from pipeline.io.meshes.atlas import join_meshes
from pipeline.io.meshes.checks import check_indices
from pipeline.io.meshes.colours import to_uint8, unit_to_uint8
from pipeline.io.meshes.companions import Companions
from pipeline.io.meshes.corners import select_faces
from pipeline.io.meshes.mtl import Material, parse_mtl
from pipeline.io.meshes.polygons import Ragged, triangulate
from pipeline.io.meshes.text import parse_numbers
from pipeline.items.objects import Mesh

_MISSING = int(np.iinfo(np.int64).min)  # a corner without texture coordinate
_MAX_FORMS = 16  # most frequent forms of faces, which are parsed together; others are parsed line by line
_MAX_COLUMNS = 8  # numbers read after v; further ones are ignored


@dataclass(frozen=True)
class _Lines:
    """An obj's bytes and the starts of its lines. ``kind``: the first two bytes of each line as one number."""

    data: UInt8[np.ndarray, " d"]
    start: Int[np.ndarray, " n"]
    kind: Int[np.ndarray, " n"]

    def select(self, word: bytes) -> Int[np.ndarray, " m"]:
        """Indices of the lines that start with this keyword or the first letters of one."""
        if len(word) == 1:
            return np.flatnonzero((self.kind == (word[0] << 8) + 32) | (self.kind == (word[0] << 8) + 9))
        return np.flatnonzero(self.kind == (word[0] << 8) + word[1])

    def count(self, marks: Bool[np.ndarray, " d"]) -> Int[np.ndarray, " n"]:
        """Number of marked bytes in each line."""
        marked = np.flatnonzero(marks)
        return np.diff(np.searchsorted(marked, self.start), append=len(marked))

    def text(self, rows: Int[np.ndarray, " m"], skip: int) -> bytes:
        """These lines, with their first ``skip`` bytes replaced by blanks."""
        chosen = np.zeros(len(self.start), dtype=bool)
        chosen[rows] = True
        lengths = np.diff(self.start, append=len(self.data))
        units = self.data[np.repeat(chosen, lengths)]
        start = np.cumsum(lengths[rows]) - lengths[rows]
        for k in range(skip):
            units[start + k] = 32
        return units.tobytes()

    def line(self, row: int) -> str:
        """One line, decoded."""
        end = self.start[row + 1] if row + 1 < len(self.start) else len(self.data)
        return self.data[self.start[row] : end].tobytes().decode(errors="replace").strip()


@dataclass(frozen=True)
class _Faces:
    """Polygons: vertex and texture coordinate (or ``_MISSING``) of each corner, and the line each came from."""

    vertex: Ragged
    uv: Int[np.ndarray, " c"]
    line: Int[np.ndarray, " n"]


@dataclass(frozen=True)
class _Surface:
    """Triangles with texture coordinates ``uv[uv_index]`` at their corners, and their materials ``names[use]``."""

    mesh: Mesh
    uv: Float[np.ndarray, "t 2"]
    uv_index: Int[np.ndarray, "f 3"]
    names: list[str]
    use: Int[np.ndarray, " f"]
    materials: dict[str, Material]


def parse_obj(path: Path, data: bytes, companions: Companions) -> Mesh:
    """The mesh in an obj's bytes, with the materials and textures it names; not checked yet. Raises BadInput."""
    lines = _split_lines(data)
    words = _count_words(lines)
    vertices, colours = _parse_vertices(path, lines, words)
    uv, faces = _parse_uv(path, lines, words), _parse_faces(path, lines, words)
    corners, _ = triangulate(vertices, faces.vertex)
    triangles, uv_index = faces.vertex.values[corners], faces.uv[corners]
    mesh = Mesh(vertices, triangles, colours=colours)
    check_indices(path, mesh)
    highest = int(uv_index.max())
    if highest >= len(uv):
        found = f"a face with texture coordinate {highest + 1}"
        raise BadInput(path, found=found, needed=f"indices from 1 to {len(uv)}")
    polygon = np.searchsorted(faces.vertex.starts, corners[:, 0], side="right") - 1
    names, use = _read_uses(lines, faces.line)
    materials = _read_materials(path, lines, companions)
    return join_meshes(path, _make_parts(_Surface(mesh, uv, uv_index, names, use[polygon], materials), companions))


def _split_lines(data: bytes) -> _Lines:
    """The lines without leading blanks and without comments after numbers."""
    data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n").replace(b"\\\n", b"  ") + b"\n"
    if data[:1] in b" \t" or b"\n " in data or b"\n\t" in data:
        data = re.sub(rb"^[ \t]+", b"", data, flags=re.MULTILINE)
    lines = _locate_lines(data)
    commented = np.searchsorted(lines.start, np.flatnonzero(lines.data == ord("#")), side="right") - 1
    if np.isin(commented, np.concatenate([lines.select(word) for word in (b"v", b"vt", b"f")])).any():
        lines = _locate_lines(re.sub(rb"^((?:v|vt|f)[ \t][^#\n]*)#.*$", rb"\1", data, flags=re.MULTILINE))
    return lines


def _locate_lines(data: bytes) -> _Lines:
    units = np.frombuffer(data, dtype=np.uint8)
    start = np.concatenate([[0], np.flatnonzero(units[:-1] == 10) + 1])
    kind = (units[start].astype(np.int64) << 8) + units[np.minimum(start + 1, len(units) - 1)]
    return _Lines(units, start, kind)


def _count_words(lines: _Lines) -> Int[np.ndarray, " n"]:
    """Number of words in each line, including its keyword."""
    blank = lines.data <= 32
    return lines.count(np.concatenate([~blank[:1], blank[:-1] & ~blank[1:]]))


def _parse_table(path: Path, lines: _Lines, word: bytes, least: int, words: Int[np.ndarray, " n"]) -> np.ndarray:
    """The numbers of all lines with this keyword, one row per line; shorter lines are padded with NaN."""
    rows = lines.select(word)
    if not len(rows):
        return np.zeros((0, least))
    columns = words[rows] - 1
    if columns.min() < least:
        row = int(rows[columns.argmin()])
        found = f"the line {lines.line(row)[:60]!r}"
        raise BadInput(path, found=found, needed=f"{least} numbers after {word.decode()}")
    flat = parse_numbers(lines.text(rows, len(word)), float)
    if len(flat) != columns.sum():
        raise BadInput(path, found=f"a word in a line of {word.decode()!r}", needed="numbers")
    if (columns == columns[0]).all():
        return flat.reshape(len(rows), columns[0])
    table = np.full((len(rows), min(int(columns.max()), _MAX_COLUMNS)), np.nan)
    start = np.cumsum(columns) - columns
    for k in range(table.shape[1]):
        has = columns > k
        table[has, k] = flat[start[has] + k]
    return table


def _parse_vertices(
    path: Path, lines: _Lines, words: Int[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "v 3"], UInt8[np.ndarray, "v 3"] | None]:
    """Positions, and colours if any vertex has one; the others are grey."""
    table = _parse_table(path, lines, b"v", 3, words)
    vertices = np.ascontiguousarray(table[:, :3])
    if table.shape[1] < 6:
        return vertices, None
    stated = ~np.isnan(table[:, 5])
    colours = np.full((len(table), 3), DEFAULT_GREY, dtype=np.uint8)
    colours[stated] = to_uint8(path, table[stated, 3:6])
    return vertices, colours


def _parse_uv(path: Path, lines: _Lines, words: Int[np.ndarray, " n"]) -> Float[np.ndarray, "t 2"]:
    """Texture coordinates; a missing second one is 0."""
    table = _parse_table(path, lines, b"vt", 1, words)[:, :2]
    return np.stack([table[:, 0], np.zeros(len(table)) if table.shape[1] < 2 else table[:, 1]], axis=-1)


def _parse_faces(path: Path, lines: _Lines, words: Int[np.ndarray, " n"]) -> _Faces:
    """All polygons in the order of their lines, with indices counted from 0."""
    rows = lines.select(b"f")
    counts = words[rows] - 1
    starts, total = np.cumsum(counts) - counts, int(counts.sum())
    vertex, uv = np.zeros(total, np.int64), np.full(total, _MISSING)
    slashes = lines.count(lines.data == 47)[rows]
    pairs = lines.count(np.concatenate([(lines.data[:-1] == 47) & (lines.data[1:] == 47), [False]]))[rows]
    parsed = np.zeros(len(rows), dtype=bool)
    for chosen in _group_alike(counts, slashes, pairs):
        count, per_corner, has_uv = _corner_shape(*(int(x[chosen[0]]) for x in (counts, slashes, pairs)))
        numbers = parse_numbers(lines.text(rows[chosen], 1).replace(b"/", b" "), np.int64)
        if per_corner and len(numbers) == len(chosen) * count * per_corner:
            numbers = numbers.reshape(len(chosen), count, per_corner)
            at = starts[chosen][:, None] + np.arange(count)
            vertex[at] = numbers[..., 0]
            if has_uv:
                uv[at] = numbers[..., 1]
            parsed[chosen] = True
    for k in np.flatnonzero(~parsed).tolist():
        at = slice(starts[k], starts[k] + counts[k])
        vertex[at], uv[at] = _parse_face(path, lines.line(int(rows[k])))
    line = np.repeat(rows, counts)
    vertex, stated = _resolve(path, vertex, lines.select(b"v"), line, lines), uv != _MISSING
    uv[stated] = _resolve(path, uv[stated], lines.select(b"vt"), line[stated], lines)
    return _Faces(Ragged(counts, vertex), uv, rows)


def _group_alike(
    counts: Int[np.ndarray, " f"], slashes: Int[np.ndarray, " f"], pairs: Int[np.ndarray, " f"]
) -> Iterator[Int[np.ndarray, " g"]]:
    """Line indices of faces with the same form, for the most frequent forms."""
    if not len(counts):
        return
    form = (counts * (slashes.max() + 1) + slashes) * (pairs.max() + 1) + pairs
    _, group, sizes = np.unique(form, return_inverse=True, return_counts=True)
    for k in np.argsort(-sizes)[:_MAX_FORMS].tolist():
        yield np.flatnonzero(group == k)


def _corner_shape(count: int, slashes: int, pairs: int) -> tuple[int, int, bool]:
    """Corners of a face, numbers per corner (0: not all alike), and whether the second is a texture coordinate."""
    if slashes == 0:
        return count, 1, False
    if slashes == count and not pairs:
        return count, 2, True
    if slashes == 2 * count and pairs in (0, count):
        return count, 2 if pairs else 3, not pairs
    return count, 0, False


def _parse_face(path: Path, line: str) -> tuple[list[int], list[int]]:
    """Vertices and texture coordinates of one line whose corners differ in form."""
    vertex, uv = [], []
    for corner in line.split()[1:]:
        found = re.fullmatch(r"([+-]?\d{1,18})(?:/([+-]?\d{1,18})?(?:/(?:[+-]?\d{1,18})?)?)?", corner)
        if found is None:
            raise BadInput(path, found=f"the line {line[:60]!r}", needed="corners such as 1, 1/2, 1//3 or 1/2/3")
        vertex.append(int(found[1]))
        uv.append(_MISSING if found[2] is None else int(found[2]))
    return vertex, uv


def _resolve(
    path: Path,
    index: Int[np.ndarray, " c"],
    defined: Int[np.ndarray, " d"],
    line: Int[np.ndarray, " c"],
    lines: _Lines,
) -> Int[np.ndarray, " c"]:
    """Indices counted from 0. Negative ones count back from their line. Raises BadInput for 0 and those before 1."""
    relative = index < 0
    resolved = index - 1
    resolved[relative] = index[relative] + np.searchsorted(defined, line[relative])
    wrong = np.flatnonzero((index == 0) | (resolved < 0))
    if len(wrong):
        found = f"index {index[wrong[0]]} in the line {lines.line(int(line[wrong[0]]))[:60]!r}"
        raise BadInput(path, found=found, needed="indices from 1, or from -1 back to the first")
    return resolved


def _read_uses(lines: _Lines, face_lines: Int[np.ndarray, " f"]) -> tuple[list[str], Int[np.ndarray, " f"]]:
    """Names of the materials in use ("" for none), and the material index of each polygon."""
    numbers, rows, used = {"": 0}, [], [0]
    for row in lines.select(b"us").tolist():
        word, *name = lines.line(row).split(None, 1)
        if word == "usemtl":
            rows.append(row)
            used.append(numbers.setdefault("".join(name), len(numbers)))
    return list(numbers), np.array(used)[np.searchsorted(np.array(rows, dtype=np.int64), face_lines)]


def _read_materials(path: Path, lines: _Lines, companions: Companions) -> dict[str, Material]:
    materials: dict[str, Material] = {}
    for row in lines.select(b"mt").tolist():
        words = lines.line(row).split(None, 1)
        if words[0] != "mtllib" or len(words) < 2:
            continue
        names = [words[1]] if len(words[1].split()) == 1 or companions.exists(words[1]) else words[1].split()
        for name in names:
            for key, material in parse_mtl(path.parent / name, companions.read(name)).items():
                materials.setdefault(key, material)
    return materials


def _make_parts(surface: _Surface, companions: Companions) -> list[Mesh]:
    """One mesh per material, and one of its faces without texture coordinates."""
    order = np.argsort(surface.use, kind="stable")
    used, start = np.unique(surface.use[order], return_index=True)
    parts = []
    for k, faces in zip(used.tolist(), np.split(order, start[1:]), strict=True):
        name = surface.names[k]
        material = surface.materials.get(name, Material())
        notes = () if not name or name in surface.materials else (f"its material {name!r} is in no material file",)
        if material.texture is None:
            parts.append(_colour_part(surface.mesh, faces, material, notes))
            continue
        has_uv = (surface.uv_index[faces] != _MISSING).all(axis=1)
        texture = companions.texture(material.texture)
        if has_uv.any():
            parts.append(_texture_part(surface, faces[has_uv], material, texture))
        if not has_uv.all():
            count = f"{(~has_uv).sum()} of its faces" if has_uv.any() else "its faces"
            notes = (f"{count} have no texture coordinates for {material.texture!r}",)
            parts.append(_colour_part(surface.mesh, faces[~has_uv], material, notes))
    return parts


def _colour_part(mesh: Mesh, faces: Int[np.ndarray, " g"], material: Material, notes: tuple[str, ...]) -> Mesh:
    """Faces with vertex colours, else the material's colour, else none."""
    part = replace(select_faces(mesh, faces), warnings=notes)
    if part.colours is not None or material.colour is None:
        return part
    colour = unit_to_uint8(np.array([material.colour]))
    return replace(part, colours=np.repeat(colour, len(part.vertices), axis=0))


def _texture_part(
    surface: _Surface, faces: Int[np.ndarray, " g"], material: Material, texture: UInt8[np.ndarray, "H W 3"]
) -> Mesh:
    """Textured faces; vertices are duplicated so that each has one texture coordinate."""
    vertex, coordinate = surface.mesh.faces[faces].reshape(-1), surface.uv_index[faces].reshape(-1)
    _, row, inverse = np.unique(vertex * len(surface.uv) + coordinate, return_index=True, return_inverse=True)
    uv = surface.uv[coordinate[row]] * material.scale + material.offset
    return Mesh(surface.mesh.vertices[vertex[row]], inverse.reshape(-1, 3), uv=uv, texture=texture)
