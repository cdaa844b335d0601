"""The feature store: entries of checksummed Zarr arrays and a JSON document, used only when complete.

An entry is a Zarr group. Its attributes say what it is made from and, written last, that it is complete. Arrays have
one chunk per row (a template, a detection), each with a crc32c: an interrupted run resumes chunk by chunk, and a
flipped byte is detected when it is read. A missing chunk, which Zarr would read as zeros, is an error.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from zarr.core.sync import sync

from pipeline.spec import canonical
from pipeline.store.arrays import Layout, list_keys, open_group, stored_bytes
from pipeline.store.backends import Backend, StoreConfig
from pipeline.store.completion import complete_attributes, completion_record
from pipeline.store.entry import Entry, mark_incomplete
from pipeline.store.keys import Ref
from pipeline.store.writing import EntryWriter, lock_entries, open_or_create_group

RowValues = Mapping[str, Mapping[str, np.ndarray]]
"""key of an entry -> array name -> values of the requested rows"""


@dataclass(frozen=True)
class FillResult:
    """Result of ``Store.fill``: rows computed now, rows reused, seconds spent computing and writing."""

    computed: int
    reused: int
    time_s: float


class Store:
    """The feature store. Only pipeline/graph uses it; a step computes the same values with and without it."""

    def __init__(self, config: StoreConfig, announce: Callable[[str], None] = lambda text: None) -> None:
        self.config = config
        self.backend: Backend = config.open()
        self.announce = announce

    @property
    def place(self) -> str:
        """Location of the store, for messages."""
        return self.backend.place

    # --- state -----------------------------------------------------------------------------------------------------

    def is_complete(self, ref: Ref) -> bool:
        """Whether the entry has a valid completion record. Chunks are checked when they are read."""
        return self._record(ref) is not None

    def state(self, ref: Ref) -> str:
        """``cached``, ``partial`` or ``missing``."""
        if self.is_complete(ref):
            return "cached"
        return "missing" if open_group(self.backend.zarr, ref.path) is None else "partial"

    def size(self, ref: Ref) -> int | None:
        """Uncompressed bytes of a complete entry, None when it is not complete."""
        record = self._record(ref)
        return None if record is None else int(record["bytes"])

    def _record(self, ref: Ref) -> Mapping[str, Any] | None:
        attributes = self.attributes(ref.path)
        return None if attributes is None else completion_record(attributes, ref.key)

    # --- reading ---------------------------------------------------------------------------------------------------

    def read(self, ref: Ref) -> Entry:
        """Open a complete entry. Raises DamagedEntry when it is missing or incomplete."""
        group = open_group(self.backend.zarr, ref.path)
        record = None if group is None else completion_record(dict(group.attrs), ref.key)
        if group is None or record is None:
            raise mark_incomplete(self.backend, ref, "it is not complete")
        return Entry(self.backend, ref, group, record)

    # --- writing ---------------------------------------------------------------------------------------------------

    def put_document(self, ref: Ref, document: Any, *, rows: int, time_s: float = 0.0) -> None:
        """Write an entry that is a JSON document without arrays, in one request.

        An entry that another process has completed is left untouched: it may be being read.
        """
        with lock_entries(self.backend, [ref], self.announce):
            if self.is_complete(ref):
                return
            attributes = complete_attributes(
                ref, {}, document, rows=rows, time_s=time_s, nbytes=len(canonical(document))
            )
            open_or_create_group(self.backend, ref, attributes, self.announce).attrs.put(attributes)

    def fill(
        self,
        refs: Mapping[Ref, Mapping[str, Layout]],
        *,
        rows: int,
        batch: int,
        compute: Callable[[list[int]], RowValues],
        document: Mapping[str, Any] | None = None,
        advance: Callable[[int], None] = lambda rows: None,
    ) -> FillResult:
        """Complete several entries that share their rows; only batches with a missing row are computed.

        Batches are the same in every run (rows 0..b-1, b..2b-1, ...), so a resumed entry has the same bytes as an
        uninterrupted one. Entries that another process has completed are left untouched.
        """
        start, computed = time.perf_counter(), 0
        with lock_entries(self.backend, list(refs), self.announce):
            writers = [
                EntryWriter.open(self.backend, ref, layouts, rows, self.announce)
                for ref, layouts in refs.items()
                if not self.is_complete(ref)
            ]
            for batch_rows in _split(rows, batch):
                computed += _compute_missing(writers, batch_rows, compute)
                advance(len(batch_rows))
            time_s = time.perf_counter() - start
            for writer in writers:
                writer.complete(dict(document or {}), time_s)
        return FillResult(computed, rows - computed, time_s)

    # --- maintenance -----------------------------------------------------------------------------------------------

    def delete(self, path: str) -> None:
        """Remove everything below a path."""
        sync(self.backend.zarr.delete_dir(path))

    def entry_paths(self) -> list[str]:
        """Paths of all entries, complete or not."""
        keys = list_keys(self.backend.zarr, "")
        paths = {_entry_path(key) for key in keys if not key.startswith(".locks/")}
        return sorted(path for path in paths if path)

    def attributes(self, path: str) -> dict[str, Any] | None:
        """An entry's attributes, None when they cannot be read."""
        group = open_group(self.backend.zarr, path)
        return None if group is None else dict(group.attrs)

    def stored_bytes(self, path: str) -> int:
        """Bytes that an entry takes where it is stored."""
        return stored_bytes(self.backend.zarr, path)


def _split(rows: int, batch: int) -> Iterator[list[int]]:
    for first in range(0, rows, batch):
        yield list(range(first, min(first + batch, rows)))


def _compute_missing(writers: list[EntryWriter], rows: list[int], compute: Callable[[list[int]], RowValues]) -> int:
    """Compute a batch if an entry lacks one of its rows, and write it there. Returns the number of rows computed."""
    lacking = [writer for writer in writers if not writer.has(rows)]
    if not lacking:
        return 0
    values = compute(rows)
    for writer in lacking:
        writer.write(values[writer.ref.key], rows)
    return len(rows)


def _entry_path(key: str) -> str | None:
    """The path of the entry that a store key belongs to: up to the first part that is a sha256 in hex."""
    parts = key.split("/")
    for i, part in enumerate(parts):
        if len(part) == 64 and set(part) <= set("0123456789abcdef"):
            return "/".join(parts[: i + 1])
    return None
