"""A store at the other end of a network, whose silence is never taken for an entry that is not there."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from zarr.abc.store import ByteRequest
from zarr.abc.store import Store as ZarrStore
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import WrapperStore

from pipeline.errors import DzopError

T = TypeVar("T")

_ANSWERS = (FileNotFoundError, IsADirectoryError, NotADirectoryError, KeyError, DzopError)
"""What says that something is not there: an answer like any other."""


class Answering(WrapperStore[ZarrStore]):
    """The wrapped store; what it raises but answers (timeouts, refusals, lost connections) becomes a DzopError."""

    def __init__(self, store: ZarrStore, place: str = "") -> None:
        super().__init__(store)
        self.place = place

    def _with_store(self, store: ZarrStore) -> Answering:
        return Answering(store, self.place)

    @contextmanager
    def _told(self) -> Iterator[None]:
        try:
            yield
        except _ANSWERS:
            raise
        except Exception as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
            raise DzopError(
                f"{self.place}: the store does not answer ({reason}); run again when it does: what is complete is kept"
            ) from None

    async def _answer(self, asked: Awaitable[T]) -> T:
        with self._told():
            return await asked

    async def _answers(self, asked: AsyncIterator[T]) -> AsyncIterator[T]:
        with self._told():
            async for item in asked:
                yield item

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        """As ZarrStore.get."""
        return await self._answer(self._store.get(key, prototype, byte_range))

    async def get_partial_values(
        self, prototype: BufferPrototype, key_ranges: Iterable[tuple[str, ByteRequest | None]]
    ) -> list[Buffer | None]:
        """As ZarrStore.get_partial_values."""
        return await self._answer(self._store.get_partial_values(prototype, key_ranges))

    async def exists(self, key: str) -> bool:
        """As ZarrStore.exists."""
        return await self._answer(self._store.exists(key))

    async def set(self, key: str, value: Buffer) -> None:
        """As ZarrStore.set."""
        await self._answer(self._store.set(key, value))

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        """As ZarrStore.set_if_not_exists."""
        await self._answer(self._store.set_if_not_exists(key, value))

    async def delete(self, key: str) -> None:
        """As ZarrStore.delete."""
        await self._answer(self._store.delete(key))

    async def delete_dir(self, prefix: str) -> None:
        """As ZarrStore.delete_dir."""
        await self._answer(self._store.delete_dir(prefix))

    async def getsize(self, key: str) -> int:
        """As ZarrStore.getsize."""
        return await self._answer(self._store.getsize(key))

    async def is_empty(self, prefix: str) -> bool:
        """As ZarrStore.is_empty."""
        return await self._answer(self._store.is_empty(prefix))

    def list(self) -> AsyncIterator[str]:
        """As ZarrStore.list."""
        return self._answers(self._store.list())

    def list_prefix(self, prefix: str) -> AsyncIterator[str]:
        """As ZarrStore.list_prefix."""
        return self._answers(self._store.list_prefix(prefix))

    def list_dir(self, prefix: str) -> AsyncIterator[str]:
        """As ZarrStore.list_dir."""
        return self._answers(self._store.list_dir(prefix))
