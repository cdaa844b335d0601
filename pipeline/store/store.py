"""The feature store: entries of checksummed Zarr arrays and a JSON document, used only when complete.

An entry is a Zarr group. Its attributes state its recipe and inputs and, written last, that it is complete. Arrays have
one chunk per row (a template, a detection), each with a crc32c that the completion record lists: an interrupted run
resumes chunk by chunk, and a flipped byte or a chunk of another row is detected on reading. A missing chunk, which Zarr
would read as zeros, is an error. An entry is not completed if one it was computed from has changed meanwhile.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from zarr.core.sync import sync

from pipeline.errors import DzopError
from pipeline.spec import canonical
from pipeline.store.arrays import (
    Layout,
    list_keys,
    read_attributes,
    read_bytes,
    stored_bytes,
    write_attributes,
    write_bytes,
)
from pipeline.store.backends import Backend, StoreConfig
from pipeline.store.completion import (
    FORMAT,
    check_format,
    complete_attributes,
    completion_record,
    content_of,
    identity,
    is_ours,
)
from pipeline.store.entry import DamagedEntry, Entry, mark_incomplete
from pipeline.store.keys import Ref
from pipeline.store.leases import Lease
from pipeline.store.writing import MARKER, EntryWriter, lock_entries, open_or_create_group

RowValues = Mapping[str, Mapping[str, np.ndarray]]
"""Entry's key -> array name -> values of the requested rows."""


@dataclass(frozen=True)
class FillResult:
    """Result of ``Store.fill``: rows computed now, rows reused, seconds spent computing and writing."""

    computed: int
    reused: int
    time_s: float


class Store:
    """The feature store. Only pipeline/graph uses it; results are the same with and without it.

    ``made_by`` describes this process (``pipeline.machine``) in the entries that it completes.
    """

    def __init__(self, config: StoreConfig, announce: Callable[[str], None] = lambda text: None) -> None:
        self.config = config
        self.backend: Backend = config.open()
        self.announce = announce
        self.made_by: Mapping[str, str] = {}
        self.lease: Lease | None = None
        self._used: dict[Ref, Any] = {}
        self._has_marker = False

    @property
    def place(self) -> str:
        """Location of the store, for messages."""
        return self.backend.place

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """Protect entries used inside the block from ``dzop cache gc`` of other processes."""
        self.join_lease("")
        try:
            yield
        finally:
            lease, self.lease = self.lease, None
            if lease is not None:
                lease.release()

    def join_lease(self, name: str) -> None:
        """Lease every entry used from now on. ``name``: the parent process's lease to join, "" for a new one."""
        self.lease = Lease(self.backend.zarr, name) if self.backend.is_shared else None

    # --- state -----------------------------------------------------------------------------------------------------

    def is_complete(self, ref: Ref) -> bool:
        """Whether the entry has a valid completion record. Chunks are checked when they are read.

        Raises NewerEntry for an entry of a newer format.
        """
        self._take_lease(ref)
        return self._record(ref) is not None

    def state(self, ref: Ref) -> str:
        """``cached``, ``partial`` or ``missing``."""
        if self._record(ref) is not None:
            return "cached"
        return "missing" if self.attributes(ref.path) is None else "partial"

    def size(self, ref: Ref) -> int | None:
        """Uncompressed bytes of a complete entry, None when it is not complete."""
        record = self._record(ref)
        return None if record is None else int(record["bytes"])

    def maker(self, ref: Ref) -> Mapping[str, str]:
        """``made_by`` of a complete entry; empty if it is incomplete or was written by a version without this field."""
        return (self._record(ref) or {}).get("made_by", {})

    def _record(self, ref: Ref) -> Mapping[str, Any] | None:
        attributes = self.attributes(ref.path)
        if attributes is None:
            return None
        check_format(attributes, f"{self.place}/{ref.path}")
        return completion_record(attributes, ref.key)

    def _take_lease(self, ref: Ref) -> None:
        lease = self.lease  # threads may still read when the run ends
        if lease is not None:
            lease.take(ref.key)

    def _keep_lease(self) -> None:
        lease = self.lease
        if lease is not None:
            lease.refresh()

    # --- reading ---------------------------------------------------------------------------------------------------

    def read(self, ref: Ref) -> Entry:
        """Open a complete entry. Raises DamagedEntry if it is missing or incomplete, NewerEntry for a newer format."""
        self._take_lease(ref)
        attributes = self.attributes(ref.path) or {}
        check_format(attributes, f"{self.place}/{ref.path}")
        record = completion_record(attributes, ref.key)
        if record is None:
            raise mark_incomplete(self.backend, ref, "it is not complete")
        return Entry(self.backend, ref, attributes, record, self._note_use)

    def _note_use(self, ref: Ref, record: Mapping[str, Any] | None) -> None:
        if record is None:
            self._used.pop(ref, None)
        else:
            self._used[ref] = content_of(record)
        self._keep_lease()

    def _check_used(self) -> None:
        """Raise DamagedEntry if an entry used since the last call is no longer complete or has other arrays.

        Call this before completing an entry, so that no result depends on entries that were removed meanwhile.
        """
        used, self._used = self._used, {}
        found = read_attributes(self.backend.zarr, [ref.path for ref in used])
        for (ref, content), attributes in zip(used.items(), found, strict=True):
            record = None if attributes is None else completion_record(attributes, ref.key)
            if record is None or content_of(record) != content:
                what = "was removed or replaced while results were computed from it"
                raise DamagedEntry(f"{self.place}/{ref.path}: {what}; run again")

    # --- writing ---------------------------------------------------------------------------------------------------

    def put_document(self, ref: Ref, document: Any, *, rows: int, time_s: float = 0.0) -> None:
        """Write an entry that is a JSON document without arrays, in one request.

        An entry that another process has completed is left untouched, because it may be in use. Raises DamagedEntry if
        an entry that this process has read since its last write was removed or replaced meanwhile.
        """
        self._check_used()
        self._take_lease(ref)
        with lock_entries(self.backend, [ref], self.announce):
            if self.is_complete(ref):
                return
            attributes = complete_attributes(
                ref, {}, document, rows=rows, time_s=time_s, nbytes=len(canonical(document)), made_by=self.made_by
            )
            self._mark_root()
            open_or_create_group(self.backend, ref, identity(ref), self.announce)
            write_attributes(self.backend.zarr, ref.path, attributes)

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
        """Complete several entries with common rows; only batches with a missing row are computed.

        Batches are the same in every run (rows 0..b-1, b..2b-1, ...), so a resumed entry has the same bytes as an
        uninterrupted one. Entries that another process has completed are left untouched. Raises DamagedEntry when an
        entry that was read meanwhile was removed or replaced.
        """
        start, computed = time.perf_counter(), 0
        for ref in refs:
            self._take_lease(ref)
        with lock_entries(self.backend, list(refs), self.announce):
            self._mark_root()
            writers = [
                EntryWriter.open(self.backend, ref, layouts, rows, self.announce)
                for ref, layouts in refs.items()
                if not self.is_complete(ref)
            ]
            with _note_on_error(writers):
                for batch_rows in _split(rows, batch):
                    computed += _compute_missing(writers, batch_rows, compute)
                    self._keep_lease()
                    advance(len(batch_rows))
                if writers:
                    self._check_used()
            time_s = time.perf_counter() - start
            for writer in writers:
                writer.complete(dict(document or {}), time_s, self.made_by)
        return FillResult(computed, rows - computed, time_s)

    def _mark_root(self) -> None:
        """Write the marker into the store's root, which ``dzop cache`` requires before it changes anything."""
        if not self._has_marker and read_bytes(self.backend.zarr, MARKER) is None:
            write_bytes(self.backend.zarr, MARKER, json.dumps({"format": FORMAT}).encode())
        self._has_marker = True

    # --- maintenance -----------------------------------------------------------------------------------------------

    def delete(self, path: str) -> None:
        """Remove an entry. Raises DzopError for any other folder, and for an entry of a newer format."""
        attributes = self.attributes(path)
        check_format(attributes or {}, f"{self.place}/{path}")
        if not self.is_ours(path):
            raise DzopError(f"{self.place}/{path}: found a folder that is not an entry of a store; it is left alone")
        sync(self.backend.zarr.delete_dir(path))

    def is_ours(self, path: str) -> bool:
        """Whether an entry's folder has our marker or, in older versions, attributes that name its key."""
        key = path.rpartition("/")[2]
        return is_ours(self.attributes(path) or {}, key) or self._has_entry_marker(path)

    def _has_entry_marker(self, path: str) -> bool:
        marker = read_bytes(self.backend.zarr, f"{path}/{MARKER}")
        return marker is not None and marker.decode(errors="replace") == path.rpartition("/")[2]

    def entry_paths(self) -> list[str]:
        """Paths of all folders that are named by a key, sorted; ``is_ours`` says whether they are entries."""
        paths = {_entry_path(key) for key in list_keys(self.backend.zarr, "") if not key.startswith(".")}
        return sorted(path for path in paths if path)

    def attributes(self, path: str) -> dict[str, Any] | None:
        """An entry's attributes, None when they cannot be read."""
        return read_attributes(self.backend.zarr, [path])[0]

    def stored_bytes(self, path: str) -> int:
        """Stored bytes of an entry."""
        return stored_bytes(self.backend.zarr, path)


def _split(rows: int, batch: int) -> Iterator[list[int]]:
    for first in range(0, rows, batch):
        yield list(range(first, min(first + batch, rows)))


@contextmanager
def _note_on_error(writers: list[EntryWriter]) -> Iterator[None]:
    """If the block is interrupted, record the stored rows for the next run, as long as the store answers."""
    try:
        yield
    except BaseException:
        with suppress(OSError, DzopError):
            for writer in writers:
                writer.stop()
        raise


def _compute_missing(writers: list[EntryWriter], rows: list[int], compute: Callable[[list[int]], RowValues]) -> int:
    """Compute a batch if any entry lacks one of its rows, and write it. Returns the number of rows computed."""
    lacking = [writer for writer in writers if not writer.has(rows)]
    if not lacking:
        return 0
    values = compute(rows)
    for writer in lacking:
        writer.write(values[writer.ref.key], rows)
    return len(rows)


def _entry_path(key: str) -> str | None:
    """The path of the entry that a store key belongs to: it ends at the first part that is a sha256 in hex."""
    parts = key.split("/")
    for i, part in enumerate(parts[:-1]):  # a file of such a name is not an entry
        if len(part) == 64 and set(part) <= set("0123456789abcdef"):
            return "/".join(parts[: i + 1])
    return None
