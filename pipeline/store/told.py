"""Errors of a network and of the server behind it, in one line that says what to do."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from typing import Any

from zarr.storage import FsspecStore, WrapperStore

from pipeline.errors import DzopError


class StoreUnreachable(DzopError):
    """A store behind a network that did not answer, or answered no. Nothing is known of its entries."""


@contextmanager
def told(place: str) -> Iterator[None]:
    """Whatever goes wrong on the way to ``place`` as StoreUnreachable.

    FileNotFoundError stays what it is, a key that is not there, but where a bucket is missing.
    """
    try:
        yield
    except DzopError:
        raise
    except FileNotFoundError as error:
        if "bucket" not in str(error).lower():
            raise
        raise StoreUnreachable(f"{place}: the bucket does not exist; make it, or mend store.url") from None
    except PermissionError as error:
        raise StoreUnreachable(f"{place}: access denied ({_brief(error)}); check the AWS credentials") from None
    except TimeoutError:
        raise StoreUnreachable(f"{place}: no answer within store.timeout_s; {_AGAIN}") from None
    except Exception as error:
        if type(error).__name__ == "NoCredentialsError":
            needed = "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or store.anonymous=true"
            raise StoreUnreachable(f"{place}: found no AWS credentials; {needed}") from None
        if not isinstance(error, OSError) and type(error).__module__.split(".")[0] not in _NETWORK:
            raise
        raise StoreUnreachable(f"{place}: {_brief(error)}; {_AGAIN}") from None


_AGAIN = "run again when it answers: what is complete is kept"
_NETWORK = ("aiobotocore", "aiohttp", "botocore", "fsspec", "s3fs")


def _brief(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


class ToldStore(WrapperStore[FsspecStore]):
    """A store that says what went wrong on the way to it."""

    def __init__(self, store: FsspecStore, place: str) -> None:
        super().__init__(store)
        self._place = place

    def _with_store(self, store: FsspecStore) -> ToldStore:
        return ToldStore(store, self._place)

    async def get(self, *args: Any, **kwargs: Any) -> Any:
        """As Zarr's."""
        with told(self._place):
            return await super().get(*args, **kwargs)

    async def exists(self, *args: Any, **kwargs: Any) -> bool:
        """As Zarr's."""
        with told(self._place):
            return await super().exists(*args, **kwargs)

    async def set(self, *args: Any, **kwargs: Any) -> None:
        """As Zarr's."""
        with told(self._place):
            await super().set(*args, **kwargs)

    async def set_if_not_exists(self, *args: Any, **kwargs: Any) -> None:
        """As Zarr's."""
        with told(self._place):
            await super().set_if_not_exists(*args, **kwargs)

    async def delete(self, *args: Any, **kwargs: Any) -> None:
        """As Zarr's."""
        with told(self._place):
            await super().delete(*args, **kwargs)

    async def delete_dir(self, *args: Any, **kwargs: Any) -> None:
        """As Zarr's."""
        with told(self._place):
            await super().delete_dir(*args, **kwargs)

    async def getsize(self, *args: Any, **kwargs: Any) -> int:
        """As Zarr's."""
        with told(self._place):
            return await super().getsize(*args, **kwargs)

    async def list_prefix(self, prefix: str) -> AsyncIterator[str]:
        """As Zarr's."""
        with told(self._place):
            async for key in super().list_prefix(prefix):
                yield key

    async def list_dir(self, prefix: str) -> AsyncIterator[str]:
        """As Zarr's."""
        with told(self._place):
            async for key in super().list_dir(prefix):
                yield key
