"""Zarr groups and arrays as the store uses them: one checksummed chunk per row.

Every function takes the Zarr store or group that it works on; none of them knows about locks or completion records.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import Any

import numpy as np
import zarr
from zarr.abc.store import Store as ZarrStore
from zarr.codecs import BytesCodec, Crc32cCodec, ZstdCodec
from zarr.core.sync import sync
from zarr.errors import BaseZarrError
from zarr.storage import MemoryStore

from pipeline.store.completion import metadata_digest

READ_ERRORS = (BaseZarrError, ValueError, KeyError, TypeError, RuntimeError, FileNotFoundError, IsADirectoryError)
"""What Zarr and its codecs raise for missing or damaged data."""

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


def open_group(store: ZarrStore, path: str) -> zarr.Group | None:
    """The group at ``path``, None when it is missing or its metadata cannot be read."""
    try:
        return zarr.open_group(store, path=path, mode="r+", zarr_format=3)
    except READ_ERRORS:
        return None


def open_array(group: zarr.Group, name: str) -> zarr.Array | None:
    """An array of a group, None when it is missing or its metadata cannot be read."""
    try:
        found = group[name]
    except READ_ERRORS:
        return None
    # write_empty_chunks is not stored in the metadata: a reopened array would skip rows of zeros
    return found.with_config(_WRITE_ZEROS) if isinstance(found, zarr.Array) else None


def create_array(group: zarr.Group, name: str, layout: Layout, rows: int) -> zarr.Array:
    """A new array of ``rows`` rows. Raises ContainsArrayError when there is one already."""
    return group.create_array(
        name,
        shape=(rows, *layout.row),
        chunks=(1, *layout.row),
        dtype=layout.dtype,
        serializer=BytesCodec(endian="little") if np.dtype(layout.dtype).itemsize > 1 else BytesCodec(endian=None),
        compressors=([ZstdCodec(level=1)] if layout.compress else []) + [Crc32cCodec()],
        config=_WRITE_ZEROS,
    )


def has_layout(array: zarr.Array, layout: Layout, rows: int) -> bool:
    """Whether the array's metadata is exactly that of a new array with this layout."""
    if array.shape != (rows, *layout.row):
        return False
    new = create_array(zarr.open_group(MemoryStore(), mode="w"), "array", layout, rows)
    return metadata_digest(array) == metadata_digest(new)


def list_keys(store: ZarrStore, prefix: str) -> list[str]:
    """Every key of the store below ``prefix``; all keys for ""."""

    async def collect() -> list[str]:
        return [key async for key in store.list_prefix(prefix and prefix + "/")]

    return sync(collect())


def stored_bytes(store: ZarrStore, prefix: str) -> int:
    """Bytes that the keys below ``prefix`` take where they are stored."""

    async def total() -> int:
        keys = [key async for key in store.list_prefix(prefix + "/")]
        return sum(await asyncio.gather(*(store.getsize(key) for key in keys)))

    return sync(total())


def present_rows(store: ZarrStore, array: zarr.Array) -> set[int]:
    """Rows whose chunk exists, found by one listing instead of one request per row."""
    keys = set(list_keys(store, array.path))
    tail = (0,) * (array.ndim - 1)
    names = (f"{array.path}/{array.metadata.encode_chunk_key((row, *tail))}" for row in range(array.shape[0]))
    return {row for row, name in enumerate(names) if name in keys}


def readable_rows(store: ZarrStore, array: zarr.Array) -> set[int]:
    """Rows whose chunk exists and passes its checksum."""
    return {row for row in present_rows(store, array) if _is_readable(array, row)}


def _is_readable(array: zarr.Array, row: int) -> bool:
    try:
        array[row]
    except READ_ERRORS:
        return False
    return True
