"""Places a store can be: local disk, memory, S3. One yaml each in conf/store."""

from __future__ import annotations

import errno
import logging
import threading
from collections import defaultdict
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Protocol

from filelock import FileLock, Timeout
from zarr.abc.store import Store as ZarrStore
from zarr.core.buffer import Buffer
from zarr.core.sync import sync
from zarr.storage import FsspecStore, LocalStore, MemoryStore

from pipeline.errors import BadInput, DzopError
from pipeline.spec import PositiveFloat, Spec, spec
from pipeline.store.remote import Answering, told

Announce = Callable[[str], None]


@dataclass(frozen=True)
class Backend:
    """An opened place: Zarr's store, where digests of large files may be remembered, and a lock per entry."""

    zarr: ZarrStore
    place: str
    folder: Path | None
    lock: Callable[[str, Announce], AbstractContextManager[None]]


class StoreConfig(Protocol):
    """What a store variant is: a place that can be opened. It enters no key."""

    def open(self) -> Backend:
        """The opened place. Raises BadInput when it cannot be used."""
        ...


@spec
class LocalStoreConfig(Spec):
    """A folder. Two processes that want the same entry: one computes, the other waits, then reads."""

    kind: ClassVar[str] = "store.local"
    root: str = "cache"

    def open(self) -> Backend:
        """The folder, created when missing."""
        root = Path(self.root).expanduser().resolve()
        try:
            root.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BadInput(
                "store.root", found=f"{root} ({error.strerror})", needed="a folder that can be made"
            ) from None
        return Backend(_Folder(root), str(root), root, lambda key, say: _file_lock(root / ".locks", key, say))


class _Folder(LocalStore):
    """A LocalStore that leaves alone what is there: zarr writes the documents of all groups above a new one again."""

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        """As LocalStore.set_if_not_exists, without a file beside it where there is nothing to do."""
        if not await self.exists(key):
            await super().set_if_not_exists(key, value)


@contextmanager
def _file_lock(folder: Path, key: str, announce: Announce):
    """Held until the block ends or the process dies: the kernel drops a dead process's lock."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / f"{key}.lock")
        with ExitStack() as stack:
            try:
                stack.enter_context(lock.acquire(timeout=0.2))
            except Timeout:
                announce("another process computes this entry: waiting for it")
                stack.enter_context(lock.acquire())
            yield
    except PermissionError as error:
        raise DzopError(f"{folder.parent}: the store is read-only here ({error.strerror}); it lacks an entry") from None
    except OSError as error:
        if error.errno == errno.EROFS:
            raise DzopError(f"{folder.parent}: the store is read-only here; it lacks an entry") from None
        raise


@spec
class MemoryStoreConfig(Spec):
    """Nothing on disk; gone with the process. For tests and for a single image."""

    kind: ClassVar[str] = "store.memory"

    def open(self) -> Backend:
        """An empty store."""
        locks: defaultdict[str, threading.RLock] = defaultdict(threading.RLock)

        @contextmanager
        def lock(key: str, announce: Announce):
            with locks[key]:
                yield

        return Backend(MemoryStore(), "memory", None, lock)


@spec
class S3StoreConfig(Spec):
    """Any S3-compatible bucket (``pip install dzop[s3]``), so that workers share one cache.

    There is no lock: two workers that want the same entry both compute it and write the same bytes. ``timeout_s``:
    how long a request may take; it is sent up to six times, with pauses, before the run ends.
    """

    kind: ClassVar[str] = "store.s3"
    url: str
    endpoint_url: str | None = None
    anonymous: bool = False
    timeout_s: PositiveFloat = 20.0

    def open(self) -> Backend:
        """The bucket and prefix of ``url``. Raises BadInput, StoreUnreachable for one that cannot be listed."""
        if not self.url.startswith("s3://") or not self.url.removeprefix("s3://").strip("/"):
            raise BadInput("store.url", found=repr(self.url), needed="s3://bucket/prefix")
        options = {
            "anon": self.anonymous,
            "endpoint_url": self.endpoint_url,
            "config_kwargs": {
                "connect_timeout": self.timeout_s,
                "read_timeout": self.timeout_s,
                "retries": {"total_max_attempts": 3, "mode": "standard"},
            },
            "use_listings_cache": False,  # other workers write there too
        }
        logging.getLogger("aiobotocore.credentials").setLevel(logging.WARNING)  # that it found them is no news
        try:
            store = FsspecStore.from_url(self.url.rstrip("/"), storage_options=options)
        except ImportError:
            raise BadInput("store", found="s3 without s3fs", needed="pip install 'dzop[s3]'") from None
        store.fs.retries = 2  # each of three attempts
        sync(_check_bucket(store, self.url))
        return Backend(Answering(store, self.url), self.url, None, lambda key, say: nullcontext())


async def _check_bucket(store: FsspecStore, url: str) -> None:
    """Raise in one line, before any work, when the bucket is not there or not ours to list."""
    bucket, _, prefix = store.path.partition("/")
    with told(url):
        try:
            await store.fs._call_s3("list_objects_v2", Bucket=bucket, Prefix=prefix, MaxKeys=1)
        except ValueError as error:  # botocore's word on an endpoint that is no URL
            raise BadInput("store.endpoint_url", found=error, needed="a URL, http://host:port") from None
