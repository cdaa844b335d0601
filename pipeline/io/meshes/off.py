"""off files, with colours of vertices (COFF) or faces."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Num, UInt8

from pipeline.errors import BadInput
from pipeline.io.meshes.checks import check_indices
from pipeline.io.meshes.colours import to_uint8
from pipeline.io.meshes.corners import split_face_colours
from pipeline.io.meshes.polygons import Ragged, triangulate
from pipeline.items.objects import Mesh

_HEADER = re.compile(r"\s*(ST)?(C)?(N)?OFF\b\s*(BINARY)?")


def parse_off(path: Path, data: bytes) -> Mesh:
    """The mesh in an off file's bytes, not checked yet. Raises BadInput."""
    text = re.sub(r"#.*", "", data.decode(errors="replace"))
    header = _HEADER.match(text)
    if header is None or header[4]:
        raise BadInput(path, found=f"the header {text[:20]!r}", needed="OFF, COFF, NOFF or STOFF as text")
    lines = [line for line in text[header.end() :].splitlines() if line.strip()]
    counts = [int(word) for word in lines[0].split()[:2]] if lines else []
    if len(counts) < 2 or min(counts) < 1 or sum(counts) > len(lines) - 1:
        found = f"{len(lines)} lines for {' and '.join(map(str, counts))} vertices and faces"
        raise BadInput(path, found=found, needed="a complete .off file with vertices and faces")
    vertex_count, face_count = counts
    table = _parse_vertices(path, lines[1 : 1 + vertex_count])
    polygons, colours = _parse_faces(path, lines[1 + vertex_count : 1 + vertex_count + face_count])
    vertices = np.ascontiguousarray(table[:, :3], dtype=float)
    corners, _ = triangulate(vertices, polygons)
    mesh = Mesh(vertices, polygons.values[corners])
    check_indices(path, mesh)
    first = 3 + 3 * bool(header[3])  # normals come before colours
    if header[2] or (not header[3] and not header[1] and table.shape[1] in (6, 7)):
        if table.shape[1] < first + 3:
            raise BadInput(path, found=f"{table.shape[1]} numbers a vertex", needed=f"{first + 3} after {header[0]}")
        return replace(mesh, colours=_to_colours(path, table[:, first : first + 3]))
    if colours is None:
        return mesh
    polygon = np.searchsorted(polygons.starts, corners[:, 0], side="right") - 1
    return split_face_colours(mesh, colours[polygon])


def _parse_vertices(path: Path, lines: list[str]) -> Num[np.ndarray, "v k"]:
    """The numbers of each vertex, with as many columns as the shortest line."""
    words = [line.split() for line in lines]
    columns = min(map(len, words))
    if columns < 3:
        raise BadInput(path, found="a vertex with fewer than 3 numbers", needed="x, y and z")
    return np.array([row[:columns] for row in words], dtype=float)


def _to_colours(path: Path, values: Num[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n 3"]:
    """Integers are 0..255, other numbers 0..1; after parsing, 1 and 1.0 are the same."""
    whole = bool((values == np.rint(values)).all()) and values.max() > 1
    return to_uint8(path, values.astype(np.int64) if whole else values)


def _parse_faces(path: Path, lines: list[str]) -> tuple[Ragged, UInt8[np.ndarray, "n 3"] | None]:
    """Polygons, and their colours if every face has three or four numbers of one."""
    words = [line.split() for line in lines]
    counts = np.array([int(row[0]) for row in words])
    if (counts < 0).any() or any(len(row) <= count for row, count in zip(words, counts.tolist(), strict=True)):
        raise BadInput(path, found="a face with fewer indices than it declares", needed="a complete .off file")
    values = [int(x) for row, count in zip(words, counts.tolist(), strict=True) for x in row[1 : 1 + count]]
    extra = [row[1 + count :] for row, count in zip(words, counts.tolist(), strict=True)]
    polygons = Ragged(counts, np.array(values, dtype=np.int64))
    if min(map(len, extra)) < 3:
        return polygons, None
    return polygons, _to_colours(path, np.array([row[:3] for row in extra], dtype=float))
