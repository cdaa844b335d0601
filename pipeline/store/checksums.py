"""Checksums of chunks, kept by array and row: noted when a chunk is written, compared when it is read.

A chunk ends with a crc32c of its own bytes, which cannot tell that it lies in the place of another row or entry. The
completion record therefore lists the checksum of every row of every array (``chunks`` on disk, eight hex digits a
row). Entries completed before there was such a list are read with the chunk's own crc32c alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import google_crc32c
from zarr.abc.store import ByteRequest
from zarr.abc.store import Store as ZarrStore
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import WrapperStore

CRC_BYTES = 4  # at the end of a chunk

RowChecksums = Mapping[int, bytes]
"""row -> the four bytes that end its chunk"""


def to_hex(checksums: RowChecksums, rows: Sequence[int]) -> str:
    """Checksums of these rows in their order, eight hex digits each."""
    return b"".join(checksums[row] for row in rows).hex()


def from_hex(text: str, first: int = 0) -> dict[int, bytes]:
    """Inverse of ``to_hex`` for consecutive rows that start with ``first``. Raises ValueError for other text."""
    found = bytes.fromhex(text)
    return {first + i // CRC_BYTES: found[i : i + CRC_BYTES] for i in range(0, len(found), CRC_BYTES)}


def chunk_key(array_path: str, ndim: int, row: int) -> str:
    """Key of a row's chunk in the store."""
    return "/".join([array_path, "c", str(row), *["0"] * (ndim - 1)])


def is_intact(chunk: bytes, checksum: bytes) -> bool:
    """Whether a chunk ends with this checksum and its bytes pass it."""
    own = int.from_bytes(checksum, "little")
    return chunk[-CRC_BYTES:] == checksum and google_crc32c.value(chunk[:-CRC_BYTES]) == own


def _last_bytes(value: Buffer) -> bytes:
    return value.as_numpy_array()[-CRC_BYTES:].tobytes()


class ChunkRecorder(WrapperStore[ZarrStore]):
    """Notes the checksum of every chunk that is written through it. ``written``: key -> the chunk's last four bytes."""

    def __init__(self, store: ZarrStore, written: dict[str, bytes] | None = None) -> None:
        super().__init__(store)
        self.written: dict[str, bytes] = {} if written is None else written

    def _with_store(self, store: ZarrStore) -> ChunkRecorder:
        return ChunkRecorder(store, self.written)

    async def set(self, key: str, value: Buffer) -> None:
        """See ZarrStore.set."""
        await self._store.set(key, value)
        self.written[key] = _last_bytes(value)


class ChunkChecker(WrapperStore[ZarrStore]):
    """Reads the chunks of one array. A missing chunk, which Zarr would read as zeros, raises FileNotFoundError.

    A chunk with another checksum than ``checksums`` has for its row raises ValueError; None compares nothing.
    """

    def __init__(self, store: ZarrStore, array_path: str, checksums: RowChecksums | None) -> None:
        super().__init__(store)
        self.prefix = f"{array_path}/c/"
        self.checksums = checksums

    def _with_store(self, store: ZarrStore) -> ChunkChecker:
        return ChunkChecker(store, self.prefix.removesuffix("/c/"), self.checksums)

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        """See ZarrStore.get."""
        value = await self._store.get(key, prototype, byte_range)
        if not key.startswith(self.prefix):
            return value
        if value is None:
            raise FileNotFoundError(key)
        if self.checksums is not None and self.checksums.get(self._row(key)) != _last_bytes(value):
            raise ValueError("a chunk is not the one that was written for its row")
        return value

    def _row(self, key: str) -> int:
        return int(key.removeprefix(self.prefix).partition("/")[0])
