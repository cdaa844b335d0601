"""Read complete entries and their arrays, checked against the completion record."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import zarr

from pipeline.errors import DzopError
from pipeline.store.arrays import READ_ERRORS, open_array, present_rows, read_attributes, write_attributes
from pipeline.store.backends import Backend
from pipeline.store.checksums import ChunkChecker, RowChecksums, from_hex
from pipeline.store.chunks import ChunkFiles
from pipeline.store.completion import check_format, metadata_digest, withdraw_record
from pipeline.store.keys import Ref
from pipeline.store.remote import AccessDenied


class DamagedEntry(DzopError):
    """A complete entry is damaged. It has been marked incomplete, so the next run repairs it."""


def mark_incomplete(backend: Backend, ref: Ref, reason: str, seal: str | None = None) -> DamagedEntry:
    """Withdraw the entry's completion record; returns the error to raise, which names ``reason``.

    ``seal``: withdraw only the record with this checksum, not one that another process has written since.
    """
    where = f"{backend.place}/{ref.path}: {reason}"
    try:
        withdraw(backend, ref.path, seal)
    except (OSError, AccessDenied, *READ_ERRORS):
        advice = "run `dzop cache verify` where the store can be written"
        return DamagedEntry(f"{where}; it cannot be marked incomplete here (read-only store?): {advice}")
    return DamagedEntry(f"{where}; run again to recompute only what is damaged")


def withdraw(backend: Backend, path: str, seal: str | None = None) -> None:
    """Remove an entry's completion record. Raises NewerEntry for an entry of a newer format."""
    (attributes,) = read_attributes(backend.zarr, [path])
    if attributes is None or "complete" not in attributes:
        return
    check_format(attributes, f"{backend.place}/{path}")
    record = attributes["complete"]
    if seal is None or (isinstance(record, Mapping) and record.get("seal") == seal):
        write_attributes(backend.zarr, path, withdraw_record(attributes))


@dataclass(eq=False)
class Entry:
    """A complete entry, open for reading.

    ``on_use`` is called with the record on every read, and with None if damage is found. ``checked_arrays``: memo of
    arrays whose metadata has been checked.
    """

    backend: Backend
    ref: Ref
    attributes: Mapping[str, Any]
    record: Mapping[str, Any]
    on_use: Callable[[Ref, Mapping[str, Any] | None], None]
    checked_arrays: dict[str, zarr.Array] = field(default_factory=dict, repr=False)
    _files: dict[str, ChunkFiles | None] = field(default_factory=dict, repr=False)
    _parsed: dict[str, RowChecksums] = field(default_factory=dict, repr=False)

    @property
    def rows(self) -> int:
        """Number of rows, such as templates or detections."""
        return int(self.record["rows"])

    @property
    def time_s(self) -> float:
        """Seconds spent computing and writing the entry."""
        return float(self.record["time_s"])

    @property
    def arrays(self) -> list[str]:
        """Names of the entry's arrays."""
        return sorted(self.record["arrays"])

    @property
    def document(self) -> Any:
        """The entry's JSON document."""
        self.on_use(self.ref, self.record)
        return self.attributes["document"]

    def array(self, name: str, rows: Iterable[int] | None = None) -> np.ndarray:
        """Values of all rows, or of the given ones in their order.

        Raises DamagedEntry for a missing chunk, a chunk of another row or entry, a wrong checksum or changed metadata.
        """
        self.on_use(self.ref, self.record)
        array = self._check_array(name)
        try:
            return self._read(name, array, range(array.shape[0]) if rows is None else list(rows))
        except (FileNotFoundError, NotADirectoryError):
            raise self._mark_damaged(self._describe_loss(name, array)) from None
        except READ_ERRORS as error:
            raise self._mark_damaged(f"array {name} does not pass its checksum ({error})") from None
        except OSError as error:
            where = f"{self.backend.place}/{self.ref.path}"
            raise DzopError(f"{where}: array {name} cannot be read ({error.strerror})") from None

    def _read(self, name: str, array: zarr.Array, rows: range | list[int]) -> np.ndarray:
        if (files := self._files[name]) is not None:
            return files.read(rows, self._checksums(name))
        first = rows[0] if rows else 0
        if list(rows) == list(range(first, first + len(rows))):  # one request for a whole batch
            return np.asarray(array[first : first + len(rows)])
        return np.stack([np.asarray(array[row]) for row in rows])

    def _check_array(self, name: str) -> zarr.Array:
        """Open an array and compare its metadata with the completion record, once."""
        if name in self.checked_arrays:
            return self.checked_arrays[name]
        path = "/".join(filter(None, [self.ref.path, self.record.get("folder", ""), name]))
        array = open_array(ChunkChecker(self.backend.zarr, path, self._checksums(name)), path)
        if array is None or metadata_digest(array) != self.record["arrays"].get(name):
            raise self._mark_damaged(f"the metadata of array {name} changed after completion")
        self.checked_arrays[name], self._files[name] = array, ChunkFiles.of(self.backend.folder, array)
        return array

    def _checksums(self, name: str) -> RowChecksums | None:
        """Checksums of an array's rows; None for entries of older versions, which did not record them."""
        chunks = self.record.get("chunks", {})
        if name in chunks and name not in self._parsed:
            self._parsed[name] = from_hex(chunks[name])
        return self._parsed.get(name)

    def _describe_loss(self, name: str, array: zarr.Array) -> str:
        rows = array.shape[0]
        missing = rows - len(present_rows(self.backend.zarr, array))
        return f"array {name} lacks {missing} of {rows} chunks" if missing else f"array {name} lost a chunk while read"

    def _mark_damaged(self, reason: str) -> DamagedEntry:
        self.on_use(self.ref, None)
        return mark_incomplete(self.backend, self.ref, reason, str(self.record["seal"]))
