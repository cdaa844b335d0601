"""A glTF 2.0 file's document, buffers and accessors."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.errors import BadInput
from pipeline.io.meshes.companions import Companions

_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_MAX_UNSTORED = 1_000_000  # limit for accessors without a buffer, which take memory but no bytes in the file
_READ = {"KHR_mesh_quantization", "KHR_texture_transform", "KHR_draco_mesh_compression", "EXT_texture_webp"}
_HARMLESS = ("KHR_materials_", "KHR_lights_", "KHR_xmp", "KHR_animation_", "EXT_lights_", "KHR_node_visibility")
"""Extensions that may be ignored: they change neither the surface nor its base colour."""
REMEDY = "a file without it: export it again, uncompressed"


class GltfFile:
    """Reads parts of a glTF file on demand. Methods raise BadInput, or lookup and type errors for malformed JSON."""

    def __init__(self, path: Path, data: bytes, companions: Companions) -> None:
        self.path, self._companions = path, companions
        text, self._chunk = _split_chunks(path, data) if data[:4] == b"glTF" else (data, None)
        try:
            self.document: dict[str, Any] = json.loads(text)
        except RecursionError:
            raise BadInput(path, found="JSON nested too deeply", needed="a glTF 2.0 file") from None
        self._buffers: dict[int, bytes] = {}
        self._check_version()
        self._check_extensions()

    def _check_version(self) -> None:
        version = str(self.document.get("asset", {}).get("version", "2.0"))
        if version.split(".")[0] != "2":
            raise BadInput(self.path, found=f"glTF version {version[:20]}", needed="version 2.0")

    def _check_extensions(self) -> None:
        for name in self.document.get("extensionsRequired", []):
            if name not in _READ and not str(name).startswith(_HARMLESS):
                raise BadInput(self.path, found=f"the required extension {name}", needed=REMEDY)

    def list(self, name: str) -> list[dict[str, Any]]:
        """A top-level list of the document, empty without it."""
        return self.document.get(name, [])

    def view(self, index: int) -> bytes:
        """Bytes of a buffer view."""
        view = self.list("bufferViews")[index]
        for name in view.get("extensions", {}):
            if "meshopt_compression" in name:
                raise BadInput(self.path, found=f"buffers in {name}", needed=REMEDY)
        start, length = view.get("byteOffset", 0), view["byteLength"]
        data = self._buffer(view["buffer"])
        if start < 0 or length < 0 or start + length > len(data):
            found = f"bufferView {index}: bytes {start} to {start + length} of {len(data)}"
            raise BadInput(self.path, found=found, needed="a complete file")
        return data[start : start + length]

    def _buffer(self, index: int) -> bytes:
        if index not in self._buffers:
            buffer = self.list("buffers")[index]
            if "uri" in buffer:
                data = self.resource(buffer["uri"])
            elif index == 0 and self._chunk is not None:
                data = self._chunk
            else:
                raise BadInput(self.path, found=f"buffer {index} without data", needed="a complete file")
            if len(data) < buffer["byteLength"]:
                found = f"{len(data)} of the {buffer['byteLength']} bytes of buffer {index}"
                raise BadInput(self.path, found=found, needed="a complete file")
            self._buffers[index] = data
        return self._buffers[index]

    def resource(self, uri: str) -> bytes:
        """Bytes of a data URI, or of a file in the mesh's folder."""
        if uri.startswith("data:"):
            _, _, encoded = uri.partition("base64,")
            return base64.b64decode(encoded)
        return self._companions.read(uri)

    def accessor(self, index: int) -> np.ndarray:
        """Elements of an accessor as stored, one row each."""
        accessor = self.list("accessors")[index]
        dtype, width, count = np.dtype(_DTYPES[accessor["componentType"]]), _WIDTHS[accessor["type"]], accessor["count"]
        if "bufferView" in accessor:
            values = self._read_rows(accessor["bufferView"], accessor.get("byteOffset", 0), dtype, width, count)
        else:
            if not 0 <= count <= _MAX_UNSTORED or "sparse" not in accessor:
                found = f"accessor {index} of {count} elements without data"
                raise BadInput(self.path, found=found, needed="elements stored in a buffer")
            values = np.zeros((count, width), dtype)
        if "sparse" in accessor:
            sparse = accessor["sparse"]
            at, put = sparse["indices"], sparse["values"]
            where = np.dtype(_DTYPES[at["componentType"]])
            rows = self._read_rows(at["bufferView"], at.get("byteOffset", 0), where, 1, sparse["count"])[:, 0]
            values = values.copy()
            values[rows] = self._read_rows(put["bufferView"], put.get("byteOffset", 0), dtype, width, sparse["count"])
        return values

    def _read_rows(self, view: int, offset: int, dtype: np.dtype[Any], width: int, count: int) -> np.ndarray:
        data, row = self.view(view), width * dtype.itemsize
        stride = self.list("bufferViews")[view].get("byteStride", row)
        if count < 1 or stride < row or offset < 0 or offset + stride * (count - 1) + row > len(data):
            found = f"{count} elements of {stride} bytes from byte {offset} on in a bufferView of {len(data)}"
            raise BadInput(self.path, found=found, needed="a complete file")
        return np.ndarray((count, width), dtype, data, offset, (stride, dtype.itemsize))

    def bounds(self, index: int) -> Float[np.ndarray, "2 k"] | None:
        """Lowest and highest values that an accessor states, None if it does not."""
        accessor = self.list("accessors")[index]
        if "min" not in accessor or "max" not in accessor:
            return None
        stated = np.array([accessor["min"], accessor["max"]], dtype=float)
        dtype = np.dtype(_DTYPES[accessor["componentType"]])
        return normalize(stated.astype(dtype)) if accessor.get("normalized") else stated

    def floats(self, index: int) -> Float[np.ndarray, "n k"]:
        """Elements of an accessor as numbers; normalized integers become 0..1 or -1..1."""
        values = self.accessor(index)
        return normalize(values) if self.list("accessors")[index].get("normalized") else values.astype(float)


def normalize(values: np.ndarray) -> Float[np.ndarray, "n k"]:
    """Integers as glTF maps them to 0..1, or -1..1 if signed; other numbers unchanged."""
    if values.dtype.kind not in "iu":
        return values.astype(float)
    return np.maximum(values / float(np.iinfo(values.dtype).max), -1)


def _split_chunks(path: Path, data: bytes) -> tuple[bytes, bytes | None]:
    """The JSON and the binary chunk of a glb."""
    if len(data) < 20 or struct.unpack_from("<I", data, 4)[0] != 2:
        raise BadInput(path, found="no glb header of version 2", needed="a complete .glb file")
    chunks, at = [], 12
    while at + 8 <= len(data):
        length, kind = struct.unpack_from("<I4s", data, at)
        if at + 8 + length > len(data):
            found = f"{len(data)} bytes where a chunk ends at {at + 8 + length}"
            raise BadInput(path, found=found, needed="a complete .glb file")
        chunks.append((kind, data[at + 8 : at + 8 + length]))
        at += 8 + length
    if not chunks or chunks[0][0] != b"JSON":
        raise BadInput(path, found="no JSON chunk", needed="a complete .glb file")
    return chunks[0][1], next((chunk for kind, chunk in chunks[1:] if kind == b"BIN\0"), None)
