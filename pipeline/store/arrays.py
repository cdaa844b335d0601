"""Zarr groups and arrays as the store uses them: one checksummed chunk per row.

Functions take the Zarr store or group to work on. Locks and completion records are handled elsewhere.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import zarr
from zarr.abc.store import Store as ZarrStore
from zarr.codecs import BytesCodec, Crc32cCodec, ZstdCodec
from zarr.core.buffer import cpu, default_buffer_prototype
from zarr.core.sync import sync
from zarr.errors import BaseZarrError
from zarr.storage import MemoryStore

from pipeline.store.checksums import SEPARATOR
from pipeline.store.completion import metadata_digest

READ_ERRORS = (BaseZarrError, ValueError, KeyError, TypeError, RuntimeError, FileNotFoundError, IsADirectoryError)
"""Exceptions that Zarr and its codecs raise for missing or damaged data."""

_WRITE_ZEROS: Any = {"write_empty_chunks": True}


@dataclass(frozen=True)
class Layout:
    """One array of an entry: shape of a row, dtype, and whether to compress it."""

    row: tuple[int, ...]
    dtype: str
    compress: bool = False

    def nbytes(self, rows: int) -> int:
        """Uncompressed bytes of ``rows`` rows."""
        return rows * int(np.prod(self.row, dtype=np.int64)) * np.dtype(self.dtype).itemsize


def read_bytes(store: ZarrStore, key: str) -> bytes | None:
    """Value of a key, None if it does not exist."""
    value = sync(store.get(key, default_buffer_prototype()))
    return None if value is None else value.to_bytes()


def write_bytes(store: ZarrStore, key: str, value: bytes) -> None:
    """Set the value of a key, atomically."""
    sync(store.set(key, cpu.Buffer.from_bytes(value)))


def read_attributes(store: ZarrStore, paths: Sequence[str]) -> list[dict[str, Any] | None]:
    """Attributes of groups, read concurrently; None for a group that is missing or has unreadable metadata."""

    async def read_all() -> list[Any]:
        prototype = default_buffer_prototype()
        return await asyncio.gather(*(store.get(f"{path}/zarr.json", prototype) for path in paths))

    return [None if value is None else _parse_attributes(value.to_bytes()) for value in sync(read_all())]


def write_attributes(store: ZarrStore, path: str, attributes: Mapping[str, Any]) -> None:
    """Replace the attributes of a group, in one request."""
    metadata = {"attributes": dict(attributes), "zarr_format": 3, "node_type": "group"}
    write_bytes(store, f"{path}/zarr.json", json.dumps(metadata, indent=2).encode())


def _parse_attributes(text: bytes) -> dict[str, Any] | None:
    try:
        metadata = json.loads(text)
        if metadata["node_type"] != "group" or metadata["zarr_format"] != 3:
            return None
        return dict(metadata.get("attributes", {}))
    except (ValueError, KeyError, TypeError, RecursionError):
        return None


def open_array(store: ZarrStore, path: str) -> zarr.Array | None:
    """The array at ``path``, None if it is missing or its metadata is unreadable."""
    try:
        found = zarr.open_array(store, path=path, mode="r+", zarr_format=3)
    except READ_ERRORS:
        return None
    # write_empty_chunks is not stored in the metadata: a reopened array would skip rows of zeros
    return found.with_config(_WRITE_ZEROS)


def create_array(store: ZarrStore, path: str, layout: Layout, rows: int) -> zarr.Array:
    """A new array of ``rows`` rows. Takes one request and writes the same bytes in every process.

    Unlike Zarr, does not write metadata for the groups above: the entry's group has been created before.
    """
    write_bytes(store, f"{path}/zarr.json", _array_metadata(layout, rows)[0])
    return zarr.open_array(store, path=path, mode="r+", zarr_format=3).with_config(_WRITE_ZEROS)


@lru_cache(maxsize=64)
def _array_metadata(layout: Layout, rows: int) -> tuple[bytes, str]:
    """Content of a new array's zarr.json, and its digest."""
    store = MemoryStore()
    array = zarr.create_array(
        store,
        name="array",
        shape=(rows, *layout.row),
        chunks=(1, *layout.row),
        dtype=layout.dtype,
        serializer=BytesCodec(endian="little") if np.dtype(layout.dtype).itemsize > 1 else BytesCodec(endian=None),
        compressors=([ZstdCodec(level=1)] if layout.compress else []) + [Crc32cCodec()],
        chunk_key_encoding={"name": "default", "separator": SEPARATOR},
        config=_WRITE_ZEROS,
    )
    return read_bytes(store, "array/zarr.json") or b"", metadata_digest(array)


def layout_digest(layout: Layout, rows: int) -> str:
    """Digest of the metadata of a new array with this layout."""
    return _array_metadata(layout, rows)[1]


def has_layout(array: zarr.Array, layout: Layout, rows: int) -> bool:
    """Whether the array's metadata is exactly that of a new array with this layout."""
    return array.shape == (rows, *layout.row) and metadata_digest(array) == layout_digest(layout, rows)


def list_keys(store: ZarrStore, prefix: str) -> list[str]:
    """Every key of the store below ``prefix``; all keys for ""."""

    async def collect() -> list[str]:
        return [key async for key in store.list_prefix(prefix and prefix + "/")]

    return sync(collect())


def delete_keys(store: ZarrStore, keys: Sequence[str]) -> None:
    """Remove keys concurrently; missing ones are no error."""

    async def delete_all() -> None:
        await asyncio.gather(*(store.delete(key) for key in keys))

    sync(delete_all())


def stored_bytes(store: ZarrStore, prefix: str) -> int:
    """Stored bytes of the keys below ``prefix``."""
    return sync(store.getsize_prefix(f"{prefix}/"))


def present_rows(store: ZarrStore, array: zarr.Array) -> set[int]:
    """Rows whose chunk exists, found by one listing instead of one request per row."""
    keys = set(list_keys(store, array.path))
    tail = (0,) * (array.ndim - 1)
    names = (f"{array.path}/{array.metadata.encode_chunk_key((row, *tail))}" for row in range(array.shape[0]))
    return {row for row, name in enumerate(names) if name in keys}
