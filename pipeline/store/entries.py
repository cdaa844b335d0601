"""Entries: groups of checksummed Zarr arrays and a JSON document, counted only when complete.

An entry is a Zarr group whose attributes say what it was made from and, written last, that it is complete. Arrays have
one chunk per row (a template, a detection), each with a crc32c, so that a killed run is resumed chunk by chunk and a
flipped byte is found when it is read. A chunk that Zarr would silently read as zeros is an error here.
"""

from __future__ import annotations

import asyncio
import errno
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
import zarr
from zarr.codecs import BytesCodec, Crc32cCodec, ZstdCodec
from zarr.core.sync import sync
from zarr.errors import BaseZarrError, ContainsArrayError, ContainsGroupError
from zarr.storage import MemoryStore

from pipeline.errors import DzopError
from pipeline.spec import canonical
from pipeline.store.backends import Backend, StoreConfig
from pipeline.store.chunks import plain, read_rows
from pipeline.store.completion import completeness, finished, identity, metadata_digest
from pipeline.store.keys import Ref

_WRITE_ZEROS: Any = {"write_empty_chunks": True}
_UNREADABLE = (BaseZarrError, ValueError, KeyError, TypeError, RuntimeError, FileNotFoundError, IsADirectoryError)


class DamagedEntry(DzopError):
    """An entry that said it was complete and is not whole. It was marked incomplete, so the next run mends it."""


@dataclass(frozen=True)
class Layout:
    """One array of an entry: the shape of a row, its dtype, and whether compressing it pays."""

    row: tuple[int, ...]
    dtype: str
    compress: bool = False

    def nbytes(self, rows: int) -> int:
        """Uncompressed bytes of ``rows`` rows."""
        return rows * int(np.prod(self.row, dtype=np.int64)) * np.dtype(self.dtype).itemsize


@dataclass(frozen=True)
class Filled:
    """What ``Store.fill`` did: rows computed now, rows found, seconds of computing and writing."""

    computed: int
    reused: int
    time_s: float


Rows = Mapping[str, Mapping[str, np.ndarray]]
"""key of an entry -> array name -> values of the rows asked for"""


class Store:
    """The feature store. pipeline/graph is its only caller; a step that does without it computes the same values."""

    def __init__(self, config: StoreConfig, announce: Callable[[str], None] = lambda text: None) -> None:
        self.config = config
        self.backend: Backend = config.open()
        self.announce = announce

    @property
    def place(self) -> str:
        """Where it is, for people."""
        return self.backend.place

    # --- state -----------------------------------------------------------------------------------------------------

    def is_complete(self, ref: Ref) -> bool:
        """Whether the entry is whole as far as its own records say; array bytes are checked when read."""
        group = self._group(ref.path)
        return group is not None and completeness(dict(group.attrs), ref.key) is not None

    def state(self, ref: Ref) -> str:
        """``cached``, ``partial`` or ``missing``."""
        if self.is_complete(ref):
            return "cached"
        return "partial" if self._group(ref.path) is not None else "missing"

    def size(self, ref: Ref) -> int | None:
        """Bytes of a complete entry's arrays, uncompressed; None when it is not complete."""
        group = self._group(ref.path)
        record = None if group is None else completeness(dict(group.attrs), ref.key)
        return None if record is None else int(record["bytes"])

    # --- reading ---------------------------------------------------------------------------------------------------

    def read(self, ref: Ref) -> Entry:
        """A complete entry. Raises DamagedEntry when it is missing or not whole."""
        group = self._group(ref.path)
        record = None if group is None else completeness(dict(group.attrs), ref.key)
        if group is None or record is None:
            raise self._damaged(ref, "it is not complete")
        return Entry(self, ref, group, record)

    def _damaged(self, ref: Ref, what: str) -> DamagedEntry:
        try:
            group = self._group(ref.path)
            if group is not None and "complete" in group.attrs:
                del group.attrs["complete"]
        except (OSError, *_UNREADABLE):
            return DamagedEntry(
                f"{self.place}/{ref.path}: {what}; it cannot be marked so here (read-only?): run `dzop cache gc`"
            )
        return DamagedEntry(f"{self.place}/{ref.path}: {what}; run again, and only what is broken is computed again")

    # --- writing ---------------------------------------------------------------------------------------------------

    def put_document(self, ref: Ref, document: Any, *, rows: int, time_s: float = 0.0) -> None:
        """A whole entry without arrays: one JSON document, written at once.

        One that another process completed meanwhile is left as it is: somebody may be reading it.
        """
        with self._exclusive([ref]):
            if self.is_complete(ref):
                return
            attributes = finished(ref, {}, document, rows=rows, time_s=time_s, nbytes=len(canonical(document)))
            self._open(ref, attributes).attrs.put(attributes)

    def fill(
        self,
        refs: Mapping[Ref, Mapping[str, Layout]],
        *,
        rows: int,
        batch: int,
        compute: Callable[[list[int]], Rows],
        document: Mapping[str, Any] | None = None,
        advance: Callable[[int], None] = lambda rows: None,
    ) -> Filled:
        """Entries that share their rows, made whole: only batches with a missing row are computed.

        Batches are the same in every run (rows 0..b-1, b..2b-1, ...), so a resumed entry has the bytes of an
        uninterrupted one. Entries that another process completed meanwhile are left as they are.
        """
        start, computed = time.perf_counter(), 0
        with self._exclusive(list(refs)):
            open_refs = {ref: layouts for ref, layouts in refs.items() if not self.is_complete(ref)}
            arrays = {ref: self._arrays(ref, layouts, rows) for ref, layouts in open_refs.items()}
            done = {ref: self._rows_done(ref, arrays[ref]) for ref in open_refs}
            for first in range(0, rows, batch):
                wanted = list(range(first, min(first + batch, rows)))
                lacking = [ref for ref in open_refs if not done[ref].issuperset(wanted)]
                if lacking:
                    values = compute(wanted)
                    for ref in lacking:
                        self._write(arrays[ref], values[ref.key], wanted)
                    computed += len(wanted)
                advance(len(wanted))
            seconds = time.perf_counter() - start
            for ref, layouts in open_refs.items():
                nbytes = sum(layout.nbytes(rows) for layout in layouts.values())
                group, written = self._group(ref.path), arrays[ref]
                if group is None or any(len(self.chunks_present(array)) < rows for array in written.values()):
                    raise self._damaged(ref, "it was removed while it was written")
                told = finished(ref, written, dict(document or {}), rows=rows, time_s=seconds, nbytes=nbytes)
                group.attrs.put(told)
        return Filled(computed, rows - computed, seconds)

    def _announce_for(self, ref: Ref, text: str) -> None:
        self.announce(f"{ref.path}: {text}")

    @contextmanager
    def _exclusive(self, refs: Sequence[Ref]):
        """Locks of the entries, taken in one order by all; a full disk told in one line."""
        with ExitStack() as stack:
            try:
                for ref in sorted(refs, key=lambda ref: ref.path):
                    stack.enter_context(self.backend.lock(ref.key, partial(self._announce_for, ref)))
                yield
            except OSError as error:
                if error.errno in (errno.ENOSPC, errno.EDQUOT):
                    raise DzopError(
                        f"{self.place}: the disk is full; make room or move the store (store.root=...), then run "
                        "again: what is complete is kept"
                    ) from None
                if error.errno in (errno.EACCES, errno.EROFS, errno.EPERM):
                    raise DzopError(f"{self.place}: the store is read-only here and lacks {refs[0].path}") from None
                raise

    # Without locks (S3) two may write one entry at once. They write the same bytes, so each leaves what the other has
    # put there, and removes only what no writer of this entry can have put. Keys are listed before their metadata is
    # read: metadata is written first, so a key that was listed has metadata that can be read, unless it is broken.

    def _open(self, ref: Ref, attributes: Mapping[str, Any]) -> zarr.Group:
        """The entry's group, with these attributes when it was not there or says that it is made from something else.

        Half a chunk of a killed run is removed: only a disk has such, and its lock is ours.
        """
        with self._groups_above(ref):
            keys, group = self.keys_below(ref.path), self._group(ref.path)
            if group is not None and _same_identity(group, ref):
                for key in keys:
                    if key.endswith(".partial"):
                        sync(self.backend.zarr.delete(key))
                return group
            if keys:
                self.delete(ref.path)
            try:
                return zarr.create_group(self.backend.zarr, path=ref.path, attributes=dict(attributes))
            except ContainsGroupError:
                return zarr.open_group(self.backend.zarr, path=ref.path, mode="r+", zarr_format=3)

    @contextmanager
    def _groups_above(self, ref: Ref):
        """The right to write documents of the groups above entries; on a disk, less those half written by a killed run.

        Zarr writes them with an entry's own group, and leaves those alone that are there.
        """
        with self.backend.lock("groups", partial(self._announce_for, ref)):
            if self.backend.folder is not None:
                for above in (self.backend.folder / ref.path).parents:
                    for half in above.glob("zarr.*.partial"):
                        half.unlink(missing_ok=True)
                    if above == self.backend.folder:
                        break
            yield

    def _arrays(self, ref: Ref, layouts: Mapping[str, Layout], rows: int) -> dict[str, zarr.Array]:
        """The entry's arrays: those of an interrupted run when they are of this layout, otherwise new ones.

        A changed byte in what describes them must start them anew too: filled again as they stand, they would never
        count as complete.
        """
        group = self._open(ref, identity(ref))
        return {name: self._array_of(group, name, layout, rows) for name, layout in layouts.items()}

    def _array_of(self, group: zarr.Group, name: str, layout: Layout, rows: int) -> zarr.Array:
        path = f"{group.path}/{name}"
        keys, found = self.keys_below(path), self._array(group, name)
        if found is not None and _fits(found, layout, rows):
            return found
        if keys:
            self.delete(path)
        try:
            return _create(group, name, layout, rows)
        except ContainsArrayError:
            made = self._array(group, name)
            assert made is not None
            return made

    def _rows_done(self, ref: Ref, arrays: Mapping[str, zarr.Array]) -> set[int]:
        """Rows whose chunks are present and pass their checksum in every array."""
        done: set[int] | None = None
        for array in arrays.values():
            present = self.chunks_present(array)
            whole = {row for row in present if _readable(array, row)}
            done = whole if done is None else done & whole
        return done or set()

    def _write(self, arrays: Mapping[str, zarr.Array], values: Mapping[str, np.ndarray], rows: Sequence[int]) -> None:
        for name, array in arrays.items():
            block = np.asarray(values[name])
            if block.shape != (len(rows), *array.shape[1:]):
                raise AssertionError(f"{name}: rows of shape {block.shape}, array {array.shape}")
            array[rows[0] : rows[-1] + 1] = block

    # --- Zarr ------------------------------------------------------------------------------------------------------

    def _group(self, path: str) -> zarr.Group | None:
        try:
            return zarr.open_group(self.backend.zarr, path=path, mode="r+", zarr_format=3)
        except _UNREADABLE:
            return None

    @staticmethod
    def _array(group: zarr.Group, name: str) -> zarr.Array | None:
        try:
            found = group[name]
        except _UNREADABLE:
            return None
        # a reopened array forgets that rows of zeros are to be written
        return found.with_config(_WRITE_ZEROS) if isinstance(found, zarr.Array) else None

    def keys_below(self, prefix: str) -> list[str]:
        """Every key of the underlying store below a prefix."""

        async def collect() -> list[str]:
            return [key async for key in self.backend.zarr.list_prefix(prefix and prefix + "/")]

        return sync(collect())

    def chunks_present(self, array: zarr.Array) -> set[int]:
        """Rows whose chunk exists, by a listing: one request for all of them."""
        keys = set(self.keys_below(array.path))
        tail = (0,) * (array.ndim - 1)
        names = (f"{array.path}/{array.metadata.encode_chunk_key((row, *tail))}" for row in range(array.shape[0]))
        return {row for row, name in enumerate(names) if name in keys}

    def delete(self, path: str) -> None:
        """Remove whatever lies below a path."""
        sync(self.backend.zarr.delete_dir(path))

    def entry_paths(self) -> list[str]:
        """Paths of all entries, complete or not: folders named by a key."""
        parents = {_entry_of(key) for key in self.keys_below("") if not key.startswith(".locks/")}
        return sorted(path for path in parents if path)

    def attributes(self, path: str) -> dict[str, Any] | None:
        """An entry's own record, None when it cannot be read."""
        group = self._group(path)
        return None if group is None else dict(group.attrs)

    def stored_bytes(self, path: str) -> int:
        """Bytes an entry takes where it is stored."""

        async def total() -> int:
            keys = [key async for key in self.backend.zarr.list_prefix(path + "/")]
            return sum(await asyncio.gather(*(self.backend.zarr.getsize(key) for key in keys)))

        return sync(total())


@dataclass(frozen=True)
class Entry:
    """A complete entry, open for reading."""

    store: Store
    ref: Ref
    group: zarr.Group
    record: Mapping[str, Any]

    @property
    def rows(self) -> int:
        """Templates, detections or whatever a row is."""
        return int(self.record["rows"])

    @property
    def time_s(self) -> float:
        """Seconds its making took."""
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
        """Values of all rows, or of some.

        Raises DamagedEntry for a missing chunk, a wrong checksum or other metadata.
        """
        array, folder = self._whole(name), self.store.backend.folder
        try:
            if folder is not None and plain(array):
                return read_rows(folder, array, range(array.shape[0]) if rows is None else list(rows))
            if rows is None:
                return np.asarray(array[...])
            wanted = list(rows)
            first = wanted[0] if wanted else 0
            if wanted == list(
                range(first, first + len(wanted))
            ):  # neighbours are read at once, as batches ask for them
                return np.asarray(array[first : first + len(wanted)])
            return np.stack([np.asarray(array[row]) for row in wanted])
        except FileNotFoundError:
            self._check_present(name, array)
            raise self.store._damaged(self.ref, f"array {name} lacked a chunk a moment ago") from None
        except _UNREADABLE as error:
            raise self.store._damaged(self.ref, f"array {name} does not pass its checksum ({error})") from None

    def _whole(self, name: str) -> zarr.Array:
        if name in self._checked:
            return self._checked[name]
        array = Store._array(self.group, name)
        if array is None or metadata_digest(array) != self.record["arrays"].get(name):
            raise self.store._damaged(self.ref, f"array {name} has other metadata than when it was completed")
        if self.store.backend.folder is None or not plain(array):  # Zarr reads a chunk that is not there as zeros
            self._check_present(name, array)
        self._checked[name] = array
        return array

    def _check_present(self, name: str, array: zarr.Array) -> None:
        missing = array.shape[0] - len(self.store.chunks_present(array))
        if missing:
            raise self.store._damaged(self.ref, f"array {name} lacks {missing} of {array.shape[0]} chunks")

    @cached_property
    def _checked(self) -> dict[str, zarr.Array]:
        return {}


def _create(group: zarr.Group, name: str, layout: Layout, rows: int) -> zarr.Array:
    return group.create_array(
        name,
        shape=(rows, *layout.row),
        chunks=(1, *layout.row),
        dtype=layout.dtype,
        serializer=BytesCodec(endian="little") if np.dtype(layout.dtype).itemsize > 1 else BytesCodec(endian=None),
        compressors=([ZstdCodec(level=1)] if layout.compress else []) + [Crc32cCodec()],
        config=_WRITE_ZEROS,
    )


def _same_identity(group: zarr.Group, ref: Ref) -> bool:
    known = identity(ref)
    try:
        return canonical({name: group.attrs.get(name) for name in known}) == canonical(known)
    except ValueError:  # a changed byte made a number that is none
        return False


def _fits(array: zarr.Array, layout: Layout, rows: int) -> bool:
    if array.shape != (rows, *layout.row):
        return False
    ours = _create(zarr.open_group(MemoryStore(), mode="w"), "array", layout, rows)
    return metadata_digest(array) == metadata_digest(ours)


def _readable(array: zarr.Array, row: int) -> bool:
    try:
        array[row]
    except _UNREADABLE:
        return False
    return True


def _entry_of(key: str) -> str | None:
    """The path of the entry a store key belongs to: up to the first part that is a sha256."""
    parts = key.split("/")
    for i, part in enumerate(parts):
        if len(part) == 64 and set(part) <= set("0123456789abcdef"):
            return "/".join(parts[: i + 1])
    return None
