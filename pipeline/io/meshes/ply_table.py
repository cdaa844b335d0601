"""A ply's header and bytes -> columns of numbers, including lists of any length."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Int

from pipeline.errors import BadInput
from pipeline.io.meshes.polygons import Ragged
from pipeline.io.meshes.text import parse_numbers

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"}
_TYPES |= {"double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_TYPES |= {"int64": "i8", "uint64": "u8", "float16": "f2", "float32": "f4", "float64": "f8"}
_MAX_HEADER = 1 << 16  # bytes


@dataclass(frozen=True)
class Property:
    """A property of an element. ``count``: type of a list's length, None for a single number."""

    name: str
    dtype: np.dtype[Any]
    count: np.dtype[Any] | None


@dataclass(frozen=True)
class Element:
    """An element as the header declares it."""

    name: str
    length: int
    properties: tuple[Property, ...]


@dataclass(frozen=True)
class Header:
    """A ply's header. ``start``: byte offset of the data."""

    encoding: str
    elements: tuple[Element, ...]
    textures: tuple[str, ...]
    start: int


Columns = dict[str, "np.ndarray | Ragged"]


def read_header(path: Path, data: bytes) -> Header:
    """A ply's header. Raises BadInput."""
    found = re.search(rb"^end_header[ \t]*(\r\n|\n|\r)", data[:_MAX_HEADER], flags=re.MULTILINE)
    found = found or re.search(rb"[\r\n]end_header[ \t]*(\r\n|\n|\r)", data[:_MAX_HEADER])
    if not data.startswith(b"ply") or found is None:
        raise BadInput(path, found="no ply header", needed="a complete .ply file")
    lines = data[: found.start()].decode(errors="replace").splitlines()
    encoding, textures = "", []
    elements: list[tuple[str, int, list[Property]]] = []
    for line in lines[1:]:
        words = line.split()
        texture = re.match(r"\s*(?:comment|obj_info)\s+TextureFile\s+(.+)", line, flags=re.IGNORECASE)
        try:
            if texture is not None:
                textures.append(texture[1].strip())
            elif words[:1] == ["format"]:
                encoding = words[1].lower()
            elif words[:1] == ["element"]:
                elements.append((words[1], int(words[2]), []))
            elif words[:1] == ["property"]:
                elements[-1][2].append(_parse_property(words[1:]))
        except (IndexError, KeyError, ValueError):
            raise BadInput(path, found=f"the header line {line[:60]!r}", needed="a ply header") from None
    if encoding not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise BadInput(path, found=f"format {encoding!r}", needed="ascii, binary_little_endian or binary_big_endian")
    declared = tuple(Element(name, length, tuple(properties)) for name, length, properties in elements)
    return Header(encoding, declared, tuple(textures), found.end())


def _parse_property(words: Sequence[str]) -> Property:
    if words[0] == "list":
        return Property(words[3], np.dtype(_TYPES[words[2].lower()]), np.dtype(_TYPES[words[1].lower()]))
    return Property(words[1], np.dtype(_TYPES[words[0].lower()]), None)


def read_columns(path: Path, data: bytes, header: Header) -> dict[str, Columns]:
    """The columns of every element, by name. Raises BadInput if the data do not match the header."""
    body = _Numbers(data[header.start :]) if header.encoding == "ascii" else _Bytes(data, header)
    start, tables = 0, {}
    for element in header.elements:
        positions, counts, start = _locate(path, body, element, start)
        tables[element.name] = {
            p.name: body.take(p.dtype, position)
            if p.count is None
            else Ragged(counts[:, k], body.take_lists(p.dtype, position, counts[:, k]))
            for k, (p, position) in enumerate(zip(element.properties, positions.T, strict=True))
        }
    if start != len(body):
        raise BadInput(path, found="more numbers than its header declares", needed="a complete .ply file")
    return tables


class _Bytes:
    """The numbers of a binary ply."""

    def __init__(self, data: bytes, header: Header) -> None:
        self.units: np.ndarray = np.frombuffer(data, dtype=np.uint8)[header.start :]
        self.order: Literal["<", ">"] = ">" if header.encoding == "binary_big_endian" else "<"

    def __len__(self) -> int:
        return len(self.units)

    def size(self, dtype: np.dtype[Any]) -> int:
        """Units that one number occupies."""
        return dtype.itemsize

    def take(self, dtype: np.dtype[Any], positions: Int[np.ndarray, " n"], count: int = 1) -> np.ndarray:
        """``count`` numbers starting at each position, row by row."""
        size = dtype.itemsize * count
        if not len(positions) or not size:
            return np.zeros(0, dtype=dtype)
        windows = np.lib.stride_tricks.sliding_window_view(self.units, size)
        return windows[positions].reshape(-1).view(dtype.newbyteorder(self.order)).astype(dtype, copy=False)

    def take_lists(
        self, dtype: np.dtype[Any], positions: Int[np.ndarray, " n"], counts: Int[np.ndarray, " n"]
    ) -> np.ndarray:
        """The numbers of lists that start at these positions, one list after the other."""
        values, starts = np.empty(int(counts.sum()), dtype=dtype), np.cumsum(counts) - counts
        for count in np.unique(counts).tolist():
            rows = np.flatnonzero(counts == count)
            values[starts[rows][:, None] + np.arange(count)] = self.take(dtype, positions[rows], count).reshape(
                -1, count
            )
        return values


class _Numbers(_Bytes):
    """The numbers of an ascii ply, each one unit long."""

    def __init__(self, text: bytes) -> None:
        self.units = parse_numbers(text, float)

    def size(self, dtype: np.dtype[Any]) -> int:
        return 1

    def take(self, dtype: np.dtype[Any], positions: Int[np.ndarray, " n"], count: int = 1) -> np.ndarray:
        with np.errstate(invalid="ignore"):
            return self.units[(positions[:, None] + np.arange(count)).reshape(-1)].astype(dtype)


def _locate(
    path: Path, body: _Bytes, element: Element, start: int
) -> tuple[Int[np.ndarray, "n p"], Int[np.ndarray, "n p"], int]:
    """Position and count of each property's numbers in each row, and the end of the element."""
    least = sum(body.size(p.dtype if p.count is None else p.count) for p in element.properties)
    if element.length < 0 or element.length * max(least, 1) > len(body) - start:
        raise _too_short(path, element)
    offsets, counts, width = _measure_row(body, element, start)
    rows = start + width * np.arange(element.length if width * element.length <= len(body) - start else 0)
    lists = [k for k, p in enumerate(element.properties) if p.count is not None]
    fits = len(rows) == element.length and all(
        (body.take(p.count, rows + offsets[k] - body.size(p.count)) == counts[k]).all()
        for k, p in enumerate(element.properties)
        if p.count is not None
    )
    if fits or not lists:
        return rows[:, None] + offsets, np.broadcast_to(counts, (len(rows), len(counts))), start + width * len(rows)
    return _walk(path, body, element, start)


def _measure_row(
    body: _Bytes, element: Element, start: int
) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"], int]:
    """Offset and count of each property within the first row, and the row's width."""
    offsets, counts, at = [], [], 0
    for p in element.properties:
        count = 1
        if p.count is not None:
            lies_inside = element.length > 0 and start + at + body.size(p.count) <= len(body)
            count = int(body.take(p.count, np.array([start + at]))[0]) if lies_inside else 0
            at += body.size(p.count)
        offsets.append(at)
        counts.append(max(count, 0))
        at += counts[-1] * body.size(p.dtype)
    return np.array(offsets, np.int64), np.array(counts, np.int64), at


def _walk(
    path: Path, body: _Bytes, element: Element, start: int
) -> tuple[Int[np.ndarray, "n p"], Int[np.ndarray, "n p"], int]:
    """As ``_locate``, but row by row, because lists differ in length."""
    shape = (element.length, len(element.properties))
    positions, counts = np.zeros(shape, np.int64), np.ones(shape, np.int64)
    units, at, end = body.units, start, len(body)
    sizes = [body.size(p.dtype) for p in element.properties]
    count_sizes = [0 if p.count is None else body.size(p.count) for p in element.properties]
    for row in range(element.length):
        for k, p in enumerate(element.properties):
            count = 1
            if p.count is not None:
                if at + count_sizes[k] > end:
                    raise _too_short(path, element)
                single = units[at] if count_sizes[k] == 1 else body.take(p.count, np.array([at]))[0]
                count = int(single)
                at += count_sizes[k]
                counts[row, k] = count
            positions[row, k] = at
            at += count * sizes[k]
            if count < 0 or at > end:
                raise _too_short(path, element)
    return positions, counts, at


def _too_short(path: Path, element: Element) -> BadInput:
    found = f"fewer numbers than the {element.length} elements {element.name!r} that its header declares"
    return BadInput(path, found=found, needed="a complete .ply file")
