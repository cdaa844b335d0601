"""Two writers of one entry without locks, as on S3: whatever the interleaving, both end with a complete entry."""

import asyncio
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field

import numpy as np
from zarr.storage import MemoryStore, WrapperStore

from pipeline.store import Store
from pipeline.store.backends import Backend
from pipeline.store.keys import Ref
from tests.store.test_store import LAYOUT, REF, compute, values

DOCUMENT = Ref("documents", REF.key, REF.made_from)


class Interrupted(WrapperStore[MemoryStore]):
    """Calls ``happen`` before its n-th request."""

    def __init__(self, store: MemoryStore, before: int = -1, happen: Callable[[], None] = lambda: None) -> None:
        super().__init__(store)
        self.requests, self.before, self.happen = 0, before, happen

    async def _turn(self) -> None:
        self.requests += 1
        if self.requests - 1 == self.before:
            await asyncio.to_thread(self.happen)

    async def get(self, *args, **kwargs):
        await self._turn()
        return await super().get(*args, **kwargs)

    async def exists(self, *args, **kwargs):
        await self._turn()
        return await super().exists(*args, **kwargs)

    async def set(self, *args, **kwargs):
        await self._turn()
        return await super().set(*args, **kwargs)

    async def delete_dir(self, *args, **kwargs):
        await self._turn()
        return await super().delete_dir(*args, **kwargs)

    async def list_prefix(self, prefix):
        await self._turn()
        async for key in super().list_prefix(prefix):
            yield key


@dataclass(frozen=True)
class Place:
    zarr: WrapperStore = field(default_factory=lambda: Interrupted(MemoryStore()))

    def open(self) -> Backend:
        return Backend(self.zarr, "toy", None, lambda key, say: nullcontext())


def write_and_read(store: Store) -> None:
    store.fill({REF: LAYOUT}, rows=2, batch=1, compute=compute)
    np.testing.assert_array_equal(store.read(REF).array("maps"), values([0, 1]))
    store.put_document(DOCUMENT, {"a": 1}, rows=1)
    assert store.read(DOCUMENT).document == {"a": 1}


def test_a_writer_overtaken_at_any_request_ends_with_a_complete_entry():
    undisturbed = Place()
    write_and_read(Store(undisturbed))
    assert undisturbed.zarr.requests > 20
    overtaken = 0
    for before in range(undisturbed.zarr.requests):
        shared = MemoryStore()
        other = Store(Place(Interrupted(shared)))
        ours = Interrupted(shared, before, lambda other=other: write_and_read(other))
        write_and_read(Store(Place(ours)))
        write_and_read(other)
        overtaken += ours.requests > before
    assert overtaken == undisturbed.zarr.requests
