"""Write entries: under locks, row by row, resuming where an interrupted run stopped.

With locks, only one process writes an entry, directly into its folder. S3 has no locks, so two processes may write the
same entry at once, and their bytes may differ: each writes into its own subfolder, and the completion record names the
one to use. Metadata above the subfolders is the same for all writers. Keys are listed before metadata is read; since a
writer stores metadata first, a listed key with unreadable metadata is damaged rather than new.
"""

from __future__ import annotations

import asyncio
import errno
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from secrets import token_hex
from typing import Any

import numpy as np
import zarr
from zarr.abc.store import Store as ZarrStore
from zarr.core.buffer import Buffer, default_buffer_prototype
from zarr.core.sync import sync
from zarr.errors import ContainsGroupError

from pipeline.errors import DzopError
from pipeline.spec import canonical
from pipeline.store.arrays import (
    Layout,
    create_array,
    has_layout,
    layout_digest,
    list_keys,
    open_array,
    present_rows,
    read_attributes,
    write_attributes,
    write_bytes,
)
from pipeline.store.backends import Announce, Backend
from pipeline.store.checksums import ChunkRecorder, RowChecksums, chunk_key, is_intact, to_hex
from pipeline.store.chunks import ChunkFiles
from pipeline.store.completion import check_format, complete_attributes, completion_record, identity
from pipeline.store.entry import mark_incomplete
from pipeline.store.journal import StoredRows, forget_rows, note_end, note_rows, read_journal
from pipeline.store.keys import Ref

MARKER = ".dzop"
"""Marker key in every entry and in a store's root; identifies them as ours even if all else is damaged."""

_NOTE_INTERVAL_S = 0.5  # a killed run loses at most this much work on a local disk; on S3 every batch is recorded
_ROWS_AT_ONCE = 32


@contextmanager
def lock_entries(backend: Backend, refs: Sequence[Ref], announce: Announce) -> Iterator[None]:
    """Hold the locks of several entries, acquired in a fixed order so that processes cannot deadlock.

    Raises DzopError when the disk is full, the store is read-only, or a file is where the store needs a folder.
    """
    with ExitStack() as stack, _explain_disk_errors(backend, refs):
        for ref in sorted(refs, key=lambda ref: ref.path):
            stack.enter_context(backend.lock(ref.key, _announce_for(ref, announce)))
        yield


@contextmanager
def _explain_disk_errors(backend: Backend, refs: Sequence[Ref]) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            advice = "make room or move the store (store.root=...), then run again: completed entries are kept"
            raise DzopError(f"{backend.place}: the disk is full; {advice}") from None
        if error.errno in (errno.EACCES, errno.EROFS, errno.EPERM):
            raise DzopError(f"{backend.place}: the store is read-only here and lacks {refs[0].path}") from None
        if isinstance(error, NotADirectoryError | FileExistsError | IsADirectoryError):
            needed = "needs a folder of the store there: move the file away"
            raise DzopError(f"{error.filename or backend.place}: found a file ({error.strerror}), {needed}") from None
        if isinstance(error, FileNotFoundError) and backend.folder and str(error.filename).startswith(backend.place):
            lost = "was removed while an entry was being written; run again"
            raise DzopError(f"{error.filename}: {lost}") from None
        raise


@dataclass(eq=False)
class EntryWriter:
    """Fills the arrays of one entry. The caller holds the entry's lock, if there are locks.

    ``folder``: of the arrays, relative to the entry. ``checksums``: by array and row, of the rows already stored.
    """

    backend: Backend
    ref: Ref
    layouts: Mapping[str, Layout]
    rows: int
    name: str
    folder: str
    recorder: ChunkRecorder
    arrays: dict[str, zarr.Array] = field(default_factory=dict)
    files: dict[str, ChunkFiles | None] = field(default_factory=dict)
    checksums: dict[str, dict[int, bytes]] = field(default_factory=dict)
    stored: set[int] = field(default_factory=set)
    _not_noted: list[int] = field(default_factory=list)
    _noted_s: float = 0.0
    _has_notes: bool = False

    @classmethod
    def open(
        cls, backend: Backend, ref: Ref, layouts: Mapping[str, Layout], rows: int, announce: Announce
    ) -> EntryWriter:
        """Create the entry, or resume it: intact rows listed in the journal are kept.

        Arrays with another layout or damaged metadata are replaced, because they could never match a completion record.
        """
        name = token_hex(8)
        folder = "" if backend.has_locks else name
        writer = cls(backend, ref, layouts, rows, name, folder, ChunkRecorder(backend.zarr))
        open_or_create_group(backend, ref, identity(ref), announce)
        journal = read_journal(backend.zarr, ref, writer._digests, has_locks=backend.has_locks)
        for array, layout in layouts.items():
            path = writer._path(folder, array)
            create = create_array if folder else _open_or_create_array
            writer.arrays[array] = create(writer.recorder, path, layout, rows)
            writer.checksums[array], writer.files[array] = {}, ChunkFiles.of(backend.folder, writer.arrays[array])
        for found in journal:
            writer._keep(found)
        writer._has_notes = bool(journal)
        writer._noted_s = time.monotonic()
        return writer

    @property
    def _digests(self) -> dict[str, str]:
        return {name: layout_digest(layout, self.rows) for name, layout in self.layouts.items()}

    def _path(self, folder: str, array: str) -> str:
        return "/".join(filter(None, [self.ref.path, folder, array]))

    def _keys(self, folder: str, row: int) -> dict[str, str]:
        """Array name -> key of a row's chunk."""
        ndims = {name: 1 + len(layout.row) for name, layout in self.layouts.items()}
        return {name: chunk_key(self._path(folder, name), ndim, row) for name, ndim in ndims.items()}

    def _keep(self, found: StoredRows) -> None:
        """Keep the journal's intact rows; copy those in another writer's folder."""
        rows = sorted(found.rows.intersection(range(self.rows)).difference(self.stored))
        for first in range(0, len(rows), _ROWS_AT_ONCE):
            sync(self._keep_rows(found, rows[first : first + _ROWS_AT_ONCE]))

    async def _keep_rows(self, found: StoredRows, rows: Sequence[int]) -> None:
        await asyncio.gather(*(self._keep_row(found, row) for row in rows))

    async def _keep_row(self, found: StoredRows, row: int) -> None:
        checksums = {name: found.checksums[name][row] for name in self.layouts}
        source, target = self._keys(found.folder, row), self._keys(self.folder, row)
        chunks = {name: await _get_intact(self.backend.zarr, source[name], checksums[name]) for name in source}
        if any(chunk is None for chunk in chunks.values()):
            return
        if found.folder != self.folder:
            await asyncio.gather(
                *(self.backend.zarr.set(target[n], chunk) for n, chunk in chunks.items() if chunk is not None)
            )
        for name, checksum in checksums.items():
            self.checksums[name][row] = checksum
        self.stored.add(row)

    def has(self, rows: Sequence[int]) -> bool:
        """Whether all of these rows are stored."""
        return self.stored.issuperset(rows)

    def write(self, values: Mapping[str, np.ndarray], rows: Sequence[int]) -> None:
        """Store consecutive rows; ``values`` has one block per array."""
        for name, array in self.arrays.items():
            block = np.asarray(values[name])
            if block.shape != (len(rows), *array.shape[1:]):
                raise AssertionError(f"{name}: rows of shape {block.shape}, array {array.shape}")
            self.checksums[name].update(self._write_block(name, array, block, rows))
        self.stored.update(rows)
        self._not_noted += rows
        due = not self.backend.has_locks or time.monotonic() - self._noted_s > _NOTE_INTERVAL_S
        if due and len(self.stored) < self.rows:  # no need after the last batch: completion follows
            self.note()

    def _write_block(self, name: str, array: zarr.Array, block: np.ndarray, rows: Sequence[int]) -> RowChecksums:
        """Store consecutive rows of one array, bypassing Zarr where possible; returns their checksums."""
        if (files := self.files[name]) is not None:
            return files.write(rows, block)
        array[rows[0] : rows[-1] + 1] = block
        return {row: self.recorder.written.pop(self._keys(self.folder, row)[name]) for row in rows}

    def note(self) -> None:
        """Add rows stored since the last call to the journal."""
        for first, last in _runs(sorted(self._not_noted)):
            note_rows(
                self.backend.zarr, self.ref, self.name, folder=self.folder, first=first,
                arrays=self._digests, chunks=self._hex_checksums(range(first, last + 1)),
            )  # fmt: skip
        self._not_noted, self._noted_s, self._has_notes = [], time.monotonic(), True

    def stop(self) -> None:
        """Record in the journal the stored rows, and that this writer ended without completing the entry."""
        self.note()
        note_end(self.backend.zarr, self.ref, self.name, folder=self.folder)

    def _hex_checksums(self, rows: Sequence[int]) -> dict[str, str]:
        return {name: to_hex(checksums, rows) for name, checksums in self.checksums.items()}

    def complete(self, document: Any, time_s: float, made_by: Mapping[str, str]) -> None:
        """Write the completion record, unless another process has completed the entry with its own rows.

        Raises DamagedEntry if another process removed rows meanwhile.
        """
        (attributes,) = read_attributes(self.backend.zarr, [self.ref.path])
        if attributes is not None and completion_record(attributes, self.ref.key) is not None:
            return
        if attributes is None or any(self._lacks_rows(array) for array in self.arrays.values()):
            raise mark_incomplete(self.backend, self.ref, "it was removed while it was being written")
        nbytes = sum(layout.nbytes(self.rows) for layout in self.layouts.values())
        attributes = complete_attributes(
            self.ref, self.arrays, document, rows=self.rows, time_s=time_s, nbytes=nbytes,
            folder=self.folder, chunks=self._hex_checksums(range(self.rows)), made_by=made_by,
        )  # fmt: skip
        write_attributes(self.backend.zarr, self.ref.path, attributes)
        if self._has_notes:
            forget_rows(self.backend.zarr, self.ref)

    def _lacks_rows(self, array: zarr.Array) -> bool:
        return len(present_rows(self.backend.zarr, array)) < self.rows


async def _get_intact(store: ZarrStore, key: str, checksum: bytes) -> Buffer | None:
    chunk = await store.get(key, default_buffer_prototype())
    return chunk if chunk is not None and is_intact(chunk.to_bytes(), checksum) else None


def _runs(rows: Sequence[int]) -> Iterator[tuple[int, int]]:
    """First and last number of each consecutive sequence."""
    start = 0
    for i in range(1, len(rows) + 1):
        if i == len(rows) or rows[i] != rows[i - 1] + 1:
            yield rows[start], rows[i - 1]
            start = i


def open_or_create_group(backend: Backend, ref: Ref, attributes: Mapping[str, Any], announce: Announce) -> None:
    """Make sure that the entry's group exists; write ``attributes`` if it is new or has another recipe or inputs.

    Also removes temporary files, which only local stores have, where we hold the lock. Raises NewerEntry for an entry
    of a newer format.
    """
    with _lock_parent_groups(backend, ref, announce):
        keys, (found,) = list_keys(backend.zarr, ref.path), read_attributes(backend.zarr, [ref.path])
        if found is not None:
            check_format(found, f"{backend.place}/{ref.path}")
        if found is not None and _has_identity(found, ref):
            for key in [key for key in keys if key.endswith(".partial")]:
                sync(backend.zarr.delete(key))
            return
        marker = f"{ref.path}/{MARKER}"
        if set(keys) - {marker}:
            sync(backend.zarr.delete_dir(ref.path))
        write_bytes(backend.zarr, marker, ref.key.encode())
        try:
            zarr.create_group(backend.zarr, path=ref.path, attributes=dict(attributes))
        except ContainsGroupError:  # another process has created it after the listing
            return


@contextmanager
def _lock_parent_groups(backend: Backend, ref: Ref, announce: Announce) -> Iterator[None]:
    """Hold the lock for the groups above entries, which Zarr creates together with an entry's group.

    Removes temporary files that a killed run left next to their metadata on a local disk.
    """
    with backend.lock("groups", _announce_for(ref, announce)):
        if backend.folder is not None:
            path = backend.folder / ref.path
            for parent in path.parents[: len(path.relative_to(backend.folder).parts)]:
                _remove_temporary_files(parent)
        yield


def _remove_temporary_files(folder: Path) -> None:
    for partial in folder.glob("zarr.*.partial"):
        partial.unlink(missing_ok=True)


def _open_or_create_array(store: ZarrStore, path: str, layout: Layout, rows: int) -> zarr.Array:
    found = open_array(store, path)
    if found is not None and has_layout(found, layout, rows):
        return found
    if list_keys(store, path):
        sync(store.delete_dir(path))
    return create_array(store, path, layout, rows)


def _has_identity(attributes: Mapping[str, Any], ref: Ref) -> bool:
    expected = identity(ref)
    try:
        return canonical({name: attributes.get(name) for name in expected}) == canonical(expected)
    except ValueError:  # a damaged byte turned a number into NaN
        return False


def _announce_for(ref: Ref, announce: Announce) -> Announce:
    return lambda text: announce(f"{ref.path}: {text}")
