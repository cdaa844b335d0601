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
_KEPT = "what is complete is kept"


class StoreUnreachable(DzopError):
    """A store behind a network that did not answer, or answered no. Nothing is known of its entries."""


@contextmanager
def told(place: str) -> Iterator[None]:
    """Whatever keeps ``place`` from answering (timeouts, refusals, lost connections) as StoreUnreachable, in one line.

    FileNotFoundError stays what it is, a key that is not there, but where a bucket is missing.
    """
    try:
        yield
    except _ANSWERS as error:
        if "bucket does not exist" not in str(error) or isinstance(error, DzopError):
            raise
        raise StoreUnreachable(f"{place}: the bucket does not exist; make it, or mend store.url") from None
    except PermissionError as error:
        needed = f"check the AWS credentials, then run again: {_KEPT}"
        raise StoreUnreachable(f"{place}: access denied ({_brief(error)}); {needed}") from None
    except Exception as error:
        if type(error).__name__ == "NoCredentialsError":
            needed = "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or store.anonymous=true"
            raise StoreUnreachable(f"{place}: found no AWS credentials; {needed}") from None
        reason = f"{type(error).__name__}: {_brief(error)}"
        if isinstance(error, TimeoutError):
            reason = "no answer within store.timeout_s"
        raise StoreUnreachable(
            f"{place}: the store does not answer ({reason}); run again when it answers: {_KEPT}"
        ) from None


def _brief(error: BaseException) -> str:
    return " ".join(str(error).split())[:200]


class Answering(WrapperStore[ZarrStore]):
    """The wrapped store; what it raises but answers becomes StoreUnreachable."""

    def __init__(self, store: ZarrStore, place: str = "") -> None:
        super().__init__(store)
        self.place = place

    def _with_store(self, store: ZarrStore) -> Answering:
        return Answering(store, self.place)

    async def _answer(self, asked: Awaitable[T]) -> T:
        with told(self.place):
            return await asked

    async def _answers(self, asked: AsyncIterator[T]) -> AsyncIterator[T]:
        with told(self.place):
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
