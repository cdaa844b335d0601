"""Writing: locks, and an entry that is filled row by row and resumed where an interrupted run stopped.

S3 has no locks, so two processes may write one entry at once. They write the same bytes: each keeps what the other has
written, and deletes only what no writer of this entry can have written. Keys are therefore listed before metadata is
read: a writer stores metadata first, so a listed key whose metadata cannot be read is damaged, not new.
"""

from __future__ import annotations

import errno
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.core.sync import sync
from zarr.errors import ContainsArrayError, ContainsGroupError

from pipeline.errors import DzopError
from pipeline.spec import canonical
from pipeline.store.arrays import (
    Layout,
    create_array,
    has_layout,
    list_keys,
    open_array,
    open_group,
    present_rows,
    readable_rows,
)
from pipeline.store.backends import Announce, Backend
from pipeline.store.completion import complete_attributes, identity
from pipeline.store.entry import mark_incomplete
from pipeline.store.keys import Ref


@contextmanager
def lock_entries(backend: Backend, refs: Sequence[Ref], announce: Announce) -> Iterator[None]:
    """Hold the locks of several entries, always taken in the same order so that processes cannot deadlock.

    Raises DzopError when the disk is full or the store is read-only.
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
        raise


@dataclass(eq=False)
class EntryWriter:
    """Fills the arrays of one entry. The caller holds the entry's lock. ``stored``: rows that need no computing."""

    backend: Backend
    ref: Ref
    layouts: Mapping[str, Layout]
    rows: int
    arrays: Mapping[str, zarr.Array]
    stored: set[int]

    @classmethod
    def open(
        cls, backend: Backend, ref: Ref, layouts: Mapping[str, Layout], rows: int, announce: Announce
    ) -> EntryWriter:
        """Create the entry, or resume it: intact rows of an interrupted run are kept.

        Arrays of another layout, or whose metadata was damaged, are replaced: filled again as they are, they would
        never match a completion record.
        """
        group = open_or_create_group(backend, ref, identity(ref), announce)
        arrays = {name: _open_or_create_array(backend, group, name, layout, rows) for name, layout in layouts.items()}
        stored = [readable_rows(backend.zarr, array) for array in arrays.values()]
        return cls(backend, ref, layouts, rows, arrays, set.intersection(*stored) if stored else set())

    def has(self, rows: Sequence[int]) -> bool:
        """Whether all of these rows are stored."""
        return self.stored.issuperset(rows)

    def write(self, values: Mapping[str, np.ndarray], rows: Sequence[int]) -> None:
        """Store consecutive rows; ``values`` has one block per array."""
        for name, array in self.arrays.items():
            block = np.asarray(values[name])
            if block.shape != (len(rows), *array.shape[1:]):
                raise AssertionError(f"{name}: rows of shape {block.shape}, array {array.shape}")
            array[rows[0] : rows[-1] + 1] = block

    def complete(self, document: Any, time_s: float) -> None:
        """Write the completion record. Raises DamagedEntry when another process removed rows meanwhile."""
        group = open_group(self.backend.zarr, self.ref.path)
        if group is None or any(self._lacks_rows(array) for array in self.arrays.values()):
            raise mark_incomplete(self.backend, self.ref, "it was removed while it was being written")
        nbytes = sum(layout.nbytes(self.rows) for layout in self.layouts.values())
        attributes = complete_attributes(self.ref, self.arrays, document, rows=self.rows, time_s=time_s, nbytes=nbytes)
        group.attrs.put(attributes)

    def _lacks_rows(self, array: zarr.Array) -> bool:
        return len(present_rows(self.backend.zarr, array)) < self.rows


def open_or_create_group(backend: Backend, ref: Ref, attributes: Mapping[str, Any], announce: Announce) -> zarr.Group:
    """The entry's group; ``attributes`` are written if it is new or was made from something else.

    Also removes the entry's temporary files: only a local store has any, and we hold the lock.
    """
    with _lock_parent_groups(backend, ref, announce):
        keys, group = list_keys(backend.zarr, ref.path), open_group(backend.zarr, ref.path)
        if group is not None and _has_identity(group, ref):
            for key in [key for key in keys if key.endswith(".partial")]:
                sync(backend.zarr.delete(key))
            return group
        if keys:
            sync(backend.zarr.delete_dir(ref.path))
        try:
            return zarr.create_group(backend.zarr, path=ref.path, attributes=dict(attributes))
        except ContainsGroupError:
            return zarr.open_group(backend.zarr, path=ref.path, mode="r+", zarr_format=3)


@contextmanager
def _lock_parent_groups(backend: Backend, ref: Ref, announce: Announce) -> Iterator[None]:
    """Hold the lock for the groups above entries, which Zarr creates along with an entry's group.

    Removes temporary files that a killed run left beside their metadata on a local disk.
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


def _open_or_create_array(backend: Backend, group: zarr.Group, name: str, layout: Layout, rows: int) -> zarr.Array:
    path = f"{group.path}/{name}"
    keys, found = list_keys(backend.zarr, path), open_array(group, name)
    if found is not None and has_layout(found, layout, rows):
        return found
    if keys:
        sync(backend.zarr.delete_dir(path))
    try:
        return create_array(group, name, layout, rows)
    except ContainsArrayError:  # another process created it since the listing
        created = open_array(group, name)
        assert created is not None
        return created


def _has_identity(group: zarr.Group, ref: Ref) -> bool:
    expected = identity(ref)
    try:
        return canonical({name: group.attrs.get(name) for name in expected}) == canonical(expected)
    except ValueError:  # a damaged byte turned a number into NaN
        return False


def _announce_for(ref: Ref, announce: Announce) -> Announce:
    return lambda text: announce(f"{ref.path}: {text}")
