"""Remote store whose network errors are never mistaken for missing keys."""

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

_MISSING_KEY = (FileNotFoundError, IsADirectoryError, NotADirectoryError, KeyError)
_RESUME = "completed entries are kept"


class StoreUnreachable(DzopError):
    """A remote store did not answer or denied access, so it is unknown which entries it holds."""


class AccessDenied(StoreUnreachable):
    """A remote store denied access."""


@contextmanager
def translate_errors(place: str) -> Iterator[None]:
    """Raise StoreUnreachable, with a one-line message, for timeouts, refusals and lost connections.

    A missing key stays FileNotFoundError (or whatever Zarr expects), unless the whole bucket is missing.
    """
    try:
        yield
    except DzopError:
        raise
    except _MISSING_KEY as error:
        if "bucket does not exist" not in str(error):
            raise
        raise StoreUnreachable(f"{place}: the bucket does not exist; create it or correct store.url") from None
    except PermissionError as error:
        advice = f"check the AWS credentials, then run again: {_RESUME}"
        raise AccessDenied(f"{place}: access denied ({_shorten(error)}); {advice}") from None
    except Exception as error:
        raise StoreUnreachable(f"{place}: {_explain(error)}") from None


def _explain(error: Exception) -> str:
    if type(error).__name__ == "NoCredentialsError":  # an exception of botocore; importing it would need the s3 extra
        return "found no AWS credentials; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or store.anonymous=true"
    reason = f"{type(error).__name__}: {_shorten(error)}"
    if isinstance(error, TimeoutError):
        reason = "no answer within store.timeout_s"
    return f"the store does not answer ({reason}); run again when it answers: {_RESUME}"


def _shorten(error: BaseException) -> str:
    return " ".join(str(error).split())[:200]


class RemoteStore(WrapperStore[ZarrStore]):
    """Wraps a Zarr store on a network and translates its errors."""

    def __init__(self, store: ZarrStore, place: str = "") -> None:
        super().__init__(store)
        self.place = place

    def _with_store(self, store: ZarrStore) -> RemoteStore:
        return RemoteStore(store, self.place)

    async def _await(self, request: Awaitable[T]) -> T:
        with translate_errors(self.place):
            return await request

    async def _iterate(self, request: AsyncIterator[T]) -> AsyncIterator[T]:
        with translate_errors(self.place):
            async for item in request:
                yield item

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        """See ZarrStore.get."""
        return await self._await(self._store.get(key, prototype, byte_range))

    async def get_partial_values(
        self, prototype: BufferPrototype, key_ranges: Iterable[tuple[str, ByteRequest | None]]
    ) -> list[Buffer | None]:
        """See ZarrStore.get_partial_values."""
        return await self._await(self._store.get_partial_values(prototype, key_ranges))

    async def exists(self, key: str) -> bool:
        """See ZarrStore.exists."""
        return await self._await(self._store.exists(key))

    async def set(self, key: str, value: Buffer) -> None:
        """See ZarrStore.set."""
        await self._await(self._store.set(key, value))

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        """See ZarrStore.set_if_not_exists."""
        await self._await(self._store.set_if_not_exists(key, value))

    async def delete(self, key: str) -> None:
        """See ZarrStore.delete."""
        await self._await(self._store.delete(key))

    async def delete_dir(self, prefix: str) -> None:
        """See ZarrStore.delete_dir."""
        await self._await(self._store.delete_dir(prefix))

    async def getsize(self, key: str) -> int:
        """See ZarrStore.getsize."""
        return await self._await(self._store.getsize(key))

    async def getsize_prefix(self, prefix: str) -> int:
        """See ZarrStore.getsize_prefix."""
        return await self._await(self._store.getsize_prefix(prefix))

    async def is_empty(self, prefix: str) -> bool:
        """See ZarrStore.is_empty."""
        return await self._await(self._store.is_empty(prefix))

    def list(self) -> AsyncIterator[str]:
        """See ZarrStore.list."""
        return self._iterate(self._store.list())

    def list_prefix(self, prefix: str) -> AsyncIterator[str]:
        """See ZarrStore.list_prefix."""
        return self._iterate(self._store.list_prefix(prefix))

    def list_dir(self, prefix: str) -> AsyncIterator[str]:
        """See ZarrStore.list_dir."""
        return self._iterate(self._store.list_dir(prefix))
