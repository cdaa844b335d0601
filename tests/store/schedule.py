"""Random schedules of writers, readers, gc, verify and faults on one store, checked against what may be read.

Every writer stores bytes of its own: each number says which entry, array, row and writer it belongs to. A read is right
if it raises DamagedEntry, or if every number names the entry, array and row that were asked for, and the arrays of one
row name one writer. Between any two requests of one actor the others may act, as on S3 or where ``flock`` does nothing.
"""

from __future__ import annotations

import asyncio
import random
import zlib
from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from itertools import count
from threading import Lock
from typing import Any

import numpy as np
from zarr.storage import WrapperStore

from pipeline.errors import DzopError
from pipeline.store import DamagedEntry, Entry, Layout, Ref, Store, make_ref
from pipeline.store.admin import collect_garbage, verify
from pipeline.store.arrays import delete_keys, list_keys, read_bytes, write_bytes
from pipeline.store.completion import NewerEntry
from pipeline.store.leases import Lease

ROWS, BATCH = 5, 2
LAYOUT = {"maps": Layout((2,), "int32"), "mask": Layout((3,), "int32", compress=True)}
SOURCES = [make_ref(f"sources/{n % 2}", {"kind": "source", "n": n}, {}) for n in range(3)]
RESULTS = [make_ref("results", {"kind": "result"}, {"source": ref.key}) for ref in SOURCES]
REFS = [*SOURCES, *RESULTS]


class Killed(BaseException):
    """The process ends here."""


class Interrupted(WrapperStore):
    """Calls ``happen`` before every request; what it returns, if anything, is done in another thread meanwhile."""

    def __init__(self, store: Any, happen: Callable[[], Callable[[], None] | None] = lambda: None) -> None:
        super().__init__(store)
        self.happen = happen

    async def others_act(self) -> None:
        if (act := self.happen()) is not None:
            await asyncio.to_thread(act)

    async def get(self, *args, **kwargs):
        await self.others_act()
        return await super().get(*args, **kwargs)

    async def set(self, *args, **kwargs):
        await self.others_act()
        return await super().set(*args, **kwargs)

    async def delete(self, *args, **kwargs):
        await self.others_act()
        return await super().delete(*args, **kwargs)

    async def delete_dir(self, *args, **kwargs):
        await self.others_act()
        return await super().delete_dir(*args, **kwargs)

    async def list_prefix(self, prefix):
        await self.others_act()
        async for key in super().list_prefix(prefix):
            yield key

    async def getsize_prefix(self, prefix):
        await self.others_act()
        return await self._store.getsize_prefix(prefix)


def numbers(ref: Ref, name: str, row: int, writer: int) -> int:
    """What a writer stores in a row of an array."""
    return (zlib.crc32(f"{ref.key} {name} {row}".encode()) & 0xFFFFF) << 8 | writer


@dataclass
class Schedule:
    """``connect`` opens the store as a new process does. ``locks``: whether locks work. ``faults``: chunks are lost,
    exchanged and damaged; without faults, a complete entry must be readable, for as long as a reader leases it.
    ``separate``: whether each writer has a folder of its own.
    """

    connect: Callable[[], Store]
    seed: int
    locks: bool = False
    faults: bool = True
    separate: bool = False
    counts: Counter[str] = field(default_factory=Counter)
    steps: int = 0
    wrong: list[str] = field(default_factory=list)
    readers: list[tuple[Store, Ref, Entry, bool]] = field(default_factory=list)
    writers: int = 0
    acting: Lock = field(default_factory=Lock)

    def __post_init__(self) -> None:
        self.rng = random.Random(self.seed)
        self.plain = self.connect()

    def run(self, steps: int) -> None:
        """Take this many steps; those that happen during another step count."""
        while self.steps < steps:
            self.step()
        self.wrong += [f"seed {self.seed}: {ref.path} is never repaired" for ref in REFS if not self.repair(ref)]

    def repair(self, ref: Ref) -> bool:
        """Fill and read an entry as often as a user would; whether it reads right in the end."""
        store = self.connect()
        for _ in range(4):
            self.attempt(store, lambda: self.fill(store, ref, lambda row: 0))
            if self.attempt(store, lambda: self.check(store.read(ref), ref, list(range(ROWS)))):
                return True
        return False

    def step(self) -> None:
        actions = [self.write, self.write, self.derive, self.derive, self.read, self.read, self.read_on, self.read_on]
        actions += [self.collect, self.check_all]
        actions += [self.swap, self.lose, self.flip] if self.faults else []
        action = self.rng.choice(actions)
        self.steps += 1
        self.counts[action.__name__] += 1
        action()

    # --- actors --------------------------------------------------------------------------------------------------

    def store(self, *, mortal: bool = True) -> Store:
        """A store as another process opens it, during whose requests other steps may happen."""
        store, asked = self.connect(), count(1)
        kill_at = self.rng.randrange(1, 60) if mortal and self.rng.random() < 0.25 else 0

        def happen() -> Callable[[], None] | None:
            if kill_at and next(asked) >= kill_at:
                raise Killed
            if not self.locks and self.rng.random() < 0.05 and self.acting.acquire(blocking=False):
                return step
            return None

        def step() -> None:
            try:
                self.step()
            finally:
                self.acting.release()

        lock = store.backend.lock if self.locks else lambda key, announce: nullcontext()
        folder = store.backend.folder if self.rng.random() < 0.5 else None  # None: read through Zarr
        store.backend = replace(store.backend, zarr=Interrupted(store.backend.zarr, happen), lock=lock, folder=folder)
        store.join_lease("")
        return store

    def attempt(self, store: Store, act: Callable[[], Any], *, keep_lease: bool = False) -> Any:
        """Act until the end, an error that a user would see, or a kill. Returns None for the latter two."""
        try:
            return act()
        except NewerEntry:  # a flipped bit made it one
            self.counts["refused as newer"] += 1
            delete_keys(self.plain.backend.zarr, [f"{ref.path}/zarr.json" for ref in REFS])
        except DzopError as error:
            if not isinstance(error, DamagedEntry) and "was removed while an entry was being written" not in str(error):
                raise
            self.counts["damage found"] += 1
            if not self.faults and self.separate and "passes" in str(error):
                self.wrong.append(f"seed {self.seed}: complete, but {error}")
        except Killed:
            self.counts["killed"] += 1
            keep_lease = self.rng.random() < 0.2  # otherwise it has expired
        finally:
            if not keep_lease:
                self.release(store)
        return None

    def write(self) -> None:
        """Fill a source entry, from the start or from where another writer stopped."""
        ref, store, writer = self.rng.choice(SOURCES), self.store(), self.next_writer()
        self.attempt(store, lambda: self.fill(store, ref, lambda row: writer))

    def derive(self) -> None:
        """Compute a result from every row of a source."""
        n, store = self.rng.randrange(len(SOURCES)), self.store()
        source, ref, writer = SOURCES[n], RESULTS[n], self.next_writer()

        def act() -> None:
            self.fill(store, source, lambda row: writer)
            entry = store.read(source)

            def from_source(row: int) -> int:
                self.check(entry, source, [row])
                return writer

            self.fill(store, ref, from_source)

        self.attempt(store, act)

    def fill(self, store: Store, ref: Ref, writer_of: Callable[[int], int]) -> None:
        def compute(rows: list[int]) -> dict:
            writers = [writer_of(row) for row in rows]
            return {ref.key: {name: block(name, rows, writers) for name in LAYOUT}}

        def block(name: str, rows: list[int], writers: list[int]) -> np.ndarray:
            values = [numbers(ref, name, row, writer) for row, writer in zip(rows, writers, strict=True)]
            return np.stack([np.full(LAYOUT[name].row, value, np.int32) for value in values])

        store.fill({ref: LAYOUT}, rows=ROWS, batch=BATCH, compute=compute)
        self.counts["completed"] += 1

    def next_writer(self) -> int:
        self.writers = (self.writers + 1) % 256
        return self.writers

    def read(self) -> None:
        """Open an entry, if it is complete, and read some of it; it stays open, with or without its lease."""
        ref, store, leased = self.rng.choice(REFS), self.store(mortal=False), self.rng.random() < 0.5

        def act() -> None:
            if store.is_complete(ref):
                entry = store.read(ref)
                self.check(entry, ref, self.some_rows())
                self.readers.append((store, ref, entry, leased))

        self.attempt(store, act, keep_lease=leased)
        while len(self.readers) > 4:
            self.release(self.readers.pop(0)[0])

    def read_on(self) -> None:
        """Read more of an entry that was opened some steps ago. Without faults, a lease keeps it readable."""
        if not self.readers:
            return
        reader = store, ref, entry, leased = self.rng.choice(self.readers)
        if not self.attempt(store, lambda: self.check(entry, ref, self.some_rows()), keep_lease=True):
            if leased and self.separate and not self.faults:
                self.wrong.append(f"seed {self.seed}: {ref.path} was removed while a reader leased it")
            self.release(store)
            if reader in self.readers:
                self.readers.remove(reader)

    def release(self, store: Store) -> None:
        """Release the leases of a process."""
        if store.lease is not None:
            Lease(self.plain.backend.zarr, store.lease.name).release()

    def some_rows(self) -> list[int]:
        return self.rng.choice([list(range(ROWS)), [self.rng.randrange(ROWS)], [3, 1]])

    def check(self, entry: Entry, ref: Ref, rows: list[int]) -> bool:
        """Read rows of all arrays; note what no writer can have written."""
        found = {name: entry.array(name, rows) for name in LAYOUT}
        for k, row in enumerate(rows):
            writers = set()
            for name in LAYOUT:
                (number,) = set(found[name][k].tolist())
                writers.add(number & 0xFF)
                if number >> 8 != numbers(ref, name, row, 0) >> 8:
                    self.wrong.append(f"seed {self.seed}: {ref.path} {name} row {row} reads {number}")
            if len(writers) > 1:
                self.wrong.append(f"seed {self.seed}: {ref.path} row {row} mixes writers {writers}")
        self.counts["rows read"] += len(rows)
        return True

    # --- maintenance and faults ----------------------------------------------------------------------------------

    def collect(self) -> None:
        """Remove incomplete entries, and sometimes complete ones; entries with a lease stay."""
        store, older = self.store(), self.rng.choice([None, None, -1.0])
        removed = self.attempt(store, lambda: collect_garbage(store, older_than_h=older, dry_run=False))
        self.counts["removed"] += len(removed or [])

    def check_all(self) -> None:
        """Read every byte of the store."""
        store = self.store()
        for path, problem in (self.attempt(store, lambda: verify(store)) or {}).items():
            if not self.faults and self.separate and "array" in problem:
                self.wrong.append(f"seed {self.seed}: complete, but {path}: {problem}")

    def swap(self) -> None:
        """Exchange two chunks, of one array or of different entries."""
        chunks = self.files()
        if len(chunks) > 1:
            a, b = self.rng.sample(chunks, 2)
            x, y = (read_bytes(self.plain.backend.zarr, key) for key in (a, b))
            if x is not None and y is not None:
                write_bytes(self.plain.backend.zarr, a, y)
                write_bytes(self.plain.backend.zarr, b, x)

    def lose(self) -> None:
        if chunks := self.files():
            delete_keys(self.plain.backend.zarr, [self.rng.choice(chunks)])

    def flip(self) -> None:
        if chunks := self.files():
            key = self.rng.choice(chunks)
            data = bytearray(read_bytes(self.plain.backend.zarr, key) or b"x")
            data[self.rng.randrange(len(data))] ^= 1 << self.rng.randrange(8)
            write_bytes(self.plain.backend.zarr, key, bytes(data))

    def files(self) -> list[str]:
        """Keys of chunks, and one time in four of metadata and journals too."""
        keys = [key for path in self.plain.entry_paths() for key in list_keys(self.plain.backend.zarr, path)]
        return sorted(keys if self.rng.random() < 0.25 else [key for key in keys if "/c." in key])
