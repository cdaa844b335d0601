"""Checksums of chunks by array and row, recorded when a chunk is written and compared when it is read.

A chunk ends with a crc32c of its own bytes, which does not show that the chunk belongs to another row or entry. The
completion record therefore lists the checksum of every row of every array (``chunks`` on disk, eight hex digits per
row). Older entries without this list are only checked against the crc32c inside each chunk.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import google_crc32c
from zarr.abc.store import ByteRequest
from zarr.abc.store import Store as ZarrStore
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import WrapperStore

SEPARATOR = "."  # in the names of chunks: an array has one folder. Older arrays have "/", and folders for each row
CRC_BYTES = 4  # size of the crc32c at the end of a chunk

RowChecksums = Mapping[int, bytes]
"""row -> the four bytes that end its chunk"""


def to_hex(checksums: RowChecksums, rows: Sequence[int]) -> str:
    """Checksums of these rows in their order, eight hex digits each."""
    return b"".join(checksums[row] for row in rows).hex()


def from_hex(text: str, first: int = 0) -> dict[int, bytes]:
    """Inverse of ``to_hex`` for consecutive rows that start with ``first``. Raises ValueError for other text."""
    found = bytes.fromhex(text)
    return {first + i // CRC_BYTES: found[i : i + CRC_BYTES] for i in range(0, len(found), CRC_BYTES)}


def chunk_key(array_path: str, ndim: int, row: int, separator: str = SEPARATOR) -> str:
    """Key of a row's chunk in the store."""
    return f"{array_path}/{separator.join(['c', str(row), *['0'] * (ndim - 1)])}"


def is_intact(chunk: bytes, checksum: bytes) -> bool:
    """Whether a chunk ends with this checksum and its bytes match it."""
    own = int.from_bytes(checksum, "little")
    return chunk[-CRC_BYTES:] == checksum and google_crc32c.value(chunk[:-CRC_BYTES]) == own


def _last_bytes(value: Buffer) -> bytes:
    return value.as_numpy_array()[-CRC_BYTES:].tobytes()


class ChunkRecorder(WrapperStore[ZarrStore]):
    """Records the checksum of every chunk written through it. ``written``: key -> the chunk's last four bytes."""

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
    """Reads the chunks of one array. A missing chunk raises FileNotFoundError, where Zarr would return zeros.

    A chunk whose checksum differs from that of its row in ``checksums`` raises ValueError; None skips this check.
    """

    def __init__(self, store: ZarrStore, array_path: str, checksums: RowChecksums | None) -> None:
        super().__init__(store)
        self.array_path = array_path
        self.checksums = checksums

    def _with_store(self, store: ZarrStore) -> ChunkChecker:
        return ChunkChecker(store, self.array_path, self.checksums)

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        """See ZarrStore.get."""
        value = await self._store.get(key, prototype, byte_range)
        row = self._row(key)
        if row is None:
            return value
        if value is None:
            raise FileNotFoundError(key)
        if self.checksums is not None and self.checksums.get(row) != _last_bytes(value):
            raise ValueError("a chunk is not the one that was written for its row")
        return value

    def _row(self, key: str) -> int | None:
        """Row of a chunk of this array; None for other keys."""
        name = key.removeprefix(f"{self.array_path}/")
        if name == key or name[:2] not in ("c.", "c/"):
            return None
        return int(name[2:].replace("/", ".").partition(".")[0])
