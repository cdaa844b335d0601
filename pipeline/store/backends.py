"""Store backends: local disk, memory, S3. Each has a yaml in conf/store."""

from __future__ import annotations

import errno
import logging
import os
import threading
from collections import defaultdict
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol

from filelock import FileLock, Timeout
from zarr.abc.store import ByteRequest
from zarr.abc.store import Store as ZarrStore
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.core.sync import sync
from zarr.storage import LocalStore, MemoryStore

from pipeline.errors import BadInput, DzopError
from pipeline.spec import PositiveFloat, Spec, spec
from pipeline.store.bucket import BucketStore
from pipeline.store.remote import RemoteStore, translate_errors

Announce = Callable[[str], None]


@dataclass(frozen=True)
class Backend:
    """An open backend.

    ``place``: its location, for messages. ``folder``: its folder on the local disk, else None.
    ``lock(name, announce)``: a context manager; ``announce`` is called with a message if it has to wait.
    ``has_locks``: whether ``lock`` excludes other writers; if not, each writer of an entry has a folder of its own.
    ``is_shared``: whether other processes can access the store.
    """

    zarr: ZarrStore
    place: str
    folder: Path | None
    lock: Callable[[str, Announce], AbstractContextManager[None]]
    has_locks: bool = False
    is_shared: bool = True


class StoreConfig(Protocol):
    """A store variant. Never part of a key: the same entry may be stored anywhere."""

    def open(self) -> Backend:
        """Open the backend. Raises BadInput when it cannot be used."""
        ...


@spec
class LocalStoreConfig(Spec):
    """A folder. If two processes need the same entry, one computes it while the other waits and then reads it."""

    kind: ClassVar[str] = "store.local"
    root: str = "cache"

    def open(self) -> Backend:
        """Open the folder, created if it is missing."""
        root = Path(self.root).expanduser().resolve()
        try:
            root.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            found = f"{root} ({error.strerror})"
            raise BadInput("store.root", found=found, needed="a folder that can be created") from None

        def lock(key: str, announce: Announce) -> AbstractContextManager[None]:
            return _lock_file(root / ".locks", key, announce)

        return Backend(_LocalStore(root), str(root), root, lock, has_locks=True)


class _LocalStore(LocalStore):
    """LocalStore that skips redundant writes: Zarr rewrites the metadata of all parent groups for each new group.

    An unreadable file (no permission, broken disk) raises DzopError.
    """

    async def get(
        self, key: str, prototype: BufferPrototype | None = None, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """See ZarrStore.get."""
        try:
            return await super().get(key, prototype, byte_range)
        except OSError as error:
            raise DzopError(f"{self.root / key}: cannot be read ({error.strerror})") from None

    async def list_prefix(self, prefix: str) -> AsyncIterator[str]:
        """See ZarrStore.list_prefix. Folders removed concurrently are no error."""
        for folder, _, names in os.walk(self.root / prefix):
            for name in names:
                yield (Path(folder) / name).relative_to(self.root).as_posix()

    async def getsize_prefix(self, prefix: str) -> int:
        """See ZarrStore.getsize_prefix. Files removed concurrently are no error."""
        total = 0
        async for key in self.list_prefix(prefix):
            with suppress(FileNotFoundError):
                total += (self.root / key).stat().st_size
        return total

    async def delete_dir(self, prefix: str) -> None:
        """See ZarrStore.delete_dir. Files removed or added concurrently are no error."""
        for folder, _, names in os.walk(self.root / prefix, topdown=False):
            for name in names:
                (Path(folder) / name).unlink(missing_ok=True)
            try:
                Path(folder).rmdir()
            except OSError as error:
                if error.errno not in (errno.ENOENT, errno.ENOTEMPTY, errno.EEXIST):
                    raise

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        """As LocalStore.set_if_not_exists, but without writing a temporary file if the key exists."""
        if not await self.exists(key):
            await super().set_if_not_exists(key, value)


@contextmanager
def _lock_file(folder: Path, key: str, announce: Announce) -> Iterator[None]:
    """Hold a file lock. The kernel releases it when the process dies. Raises DzopError on a read-only disk."""
    with _explain_read_only(folder.parent), ExitStack() as stack:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / f"{key}.lock")
        try:
            stack.enter_context(lock.acquire(timeout=0.2))
        except Timeout:
            announce("another process is computing this entry; waiting for it")
            stack.enter_context(lock.acquire())
        yield


@contextmanager
def _explain_read_only(root: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if not isinstance(error, PermissionError) and error.errno != errno.EROFS:
            raise
        raise DzopError(f"{root}: the store is read-only here ({error.strerror}) and lacks an entry") from None


@spec
class MemoryStoreConfig(Spec):
    """In memory, lost when the process ends: for tests and single images."""

    kind: ClassVar[str] = "store.memory"

    def open(self) -> Backend:
        """Open an empty store."""
        locks: defaultdict[str, threading.RLock] = defaultdict(threading.RLock)

        @contextmanager
        def lock(key: str, announce: Announce):
            with locks[key]:
                yield

        return Backend(MemoryStore(), "memory", None, lock, has_locks=True, is_shared=False)


@spec
class S3StoreConfig(Spec):
    """An S3-compatible bucket (``pip install --editable '.[s3]'``), so that several machines share one cache.

    There are no locks: two workers that need the same entry both compute it, each in its own folder, and the completion
    record names the folder to use. ``timeout_s``: limit of one request, which is retried up to five times, with pauses,
    before the run fails.
    """

    kind: ClassVar[str] = "store.s3"
    url: str
    endpoint_url: str | None = None
    anonymous: bool = False
    timeout_s: PositiveFloat = 20.0

    def open(self) -> Backend:
        """Open the bucket. Raises BadInput for a malformed URL, StoreUnreachable if the bucket cannot be listed."""
        if not self.url.startswith("s3://") or not self.url.removeprefix("s3://").strip("/"):
            raise BadInput("store.url", found=repr(self.url), needed="s3://bucket/prefix")
        logging.getLogger("aiobotocore.credentials").setLevel(logging.WARNING)  # it logs where it finds credentials
        try:
            store = BucketStore.open_url(self.url.rstrip("/"), self._options())
        except ImportError:
            raise BadInput(
                "store", found="s3fs, which is not installed", needed="pip install --editable '.[s3]'"
            ) from None
        store.fs.retries = 2  # s3fs's own, on top of botocore's three: six requests in all
        sync(_check_bucket(store, self.url))
        return Backend(RemoteStore(store, self.url), self.url, None, lambda key, announce: nullcontext())

    def _options(self) -> dict[str, Any]:
        """Options of s3fs."""
        return {
            "anon": self.anonymous,
            "endpoint_url": self.endpoint_url,
            "config_kwargs": {
                "connect_timeout": self.timeout_s,
                "read_timeout": self.timeout_s,
                "retries": {"total_max_attempts": 3, "mode": "standard"},
            },
            "use_listings_cache": False,  # other workers write there too
            "max_concurrency": 1,  # one request per read: with more, s3fs would first ask for the size
        }


async def _check_bucket(store: BucketStore, url: str) -> None:
    """List one key, so that a missing or forbidden bucket is reported before any work."""
    bucket, _, prefix = store.path.partition("/")
    with translate_errors(url):
        try:
            await store.fs._call_s3("list_objects_v2", Bucket=bucket, Prefix=prefix, MaxKeys=1)
        except ValueError as error:  # from botocore, if the endpoint is not a URL
            raise BadInput("store.endpoint_url", found=error, needed="a URL, http://host:port") from None
