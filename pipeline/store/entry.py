"""Reading: a complete entry and its arrays, checked against its completion record."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import zarr

from pipeline.errors import DzopError
from pipeline.store.arrays import READ_ERRORS, open_array, open_group, present_rows
from pipeline.store.backends import Backend
from pipeline.store.chunks import has_raw_chunks, read_rows
from pipeline.store.completion import metadata_digest
from pipeline.store.keys import Ref


class DamagedEntry(DzopError):
    """A complete entry turned out to be damaged. It has been marked incomplete, so the next run repairs it."""


def mark_incomplete(backend: Backend, ref: Ref, reason: str) -> DamagedEntry:
    """Remove the entry's completion record; returns the error to raise, which names ``reason``."""
    where = f"{backend.place}/{ref.path}: {reason}"
    try:
        group = open_group(backend.zarr, ref.path)
        if group is not None and "complete" in group.attrs:
            del group.attrs["complete"]
    except (OSError, *READ_ERRORS):
        advice = "run `dzop cache verify` where the store can be written"
        return DamagedEntry(f"{where}; it cannot be marked incomplete here (read-only store?): {advice}")
    return DamagedEntry(f"{where}; run again to recompute only what is damaged")


@dataclass(eq=False)
class Entry:
    """A complete entry, open for reading. ``checked_arrays``: memo of arrays whose metadata has been checked."""

    backend: Backend
    ref: Ref
    group: zarr.Group
    record: Mapping[str, Any]
    checked_arrays: dict[str, zarr.Array] = field(default_factory=dict, repr=False)

    @property
    def rows(self) -> int:
        """Number of rows: templates, detections or whatever the entry holds."""
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
        return self.group.attrs["document"]

    def array(self, name: str, rows: Iterable[int] | None = None) -> np.ndarray:
        """Values of all rows, or of the given ones in their order.

        Raises DamagedEntry for a missing chunk, a wrong checksum or changed metadata.
        """
        array = self._check_array(name)
        try:
            return self._read(array, range(array.shape[0]) if rows is None else list(rows))
        except FileNotFoundError:
            self._check_chunks(name, array)
            raise mark_incomplete(self.backend, self.ref, f"array {name} lost a chunk while it was read") from None
        except READ_ERRORS as error:
            reason = f"array {name} does not pass its checksum ({error})"
            raise mark_incomplete(self.backend, self.ref, reason) from None

    def _read(self, array: zarr.Array, rows: range | list[int]) -> np.ndarray:
        if self.backend.folder is not None and has_raw_chunks(array):
            return read_rows(self.backend.folder, array, rows)
        first = rows[0] if rows else 0
        if list(rows) == list(range(first, first + len(rows))):  # one request for a whole batch
            return np.asarray(array[first : first + len(rows)])
        return np.stack([np.asarray(array[row]) for row in rows])

    def _check_array(self, name: str) -> zarr.Array:
        """Open an array and compare its metadata with the completion record, once."""
        if name in self.checked_arrays:
            return self.checked_arrays[name]
        array = open_array(self.group, name)
        if array is None or metadata_digest(array) != self.record["arrays"].get(name):
            raise mark_incomplete(self.backend, self.ref, f"the metadata of array {name} changed after completion")
        if self.backend.folder is None or not has_raw_chunks(array):  # Zarr reads a missing chunk as zeros
            self._check_chunks(name, array)
        self.checked_arrays[name] = array
        return array

    def _check_chunks(self, name: str, array: zarr.Array) -> None:
        rows = array.shape[0]
        missing = rows - len(present_rows(self.backend.zarr, array))
        if missing:
            raise mark_incomplete(self.backend, self.ref, f"array {name} lacks {missing} of {rows} chunks")
