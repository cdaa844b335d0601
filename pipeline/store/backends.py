"""Places a store can be: local disk, memory, S3. One yaml each in conf/store."""

from __future__ import annotations

import errno
import threading
from collections import defaultdict
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Protocol

from filelock import FileLock, Timeout
from zarr.abc.store import Store as ZarrStore
from zarr.storage import FsspecStore, LocalStore, MemoryStore

from pipeline.errors import BadInput, DzopError
from pipeline.spec import Spec, spec
from pipeline.store.answering import Answering

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
        return Backend(LocalStore(root), str(root), root, lambda key, say: _file_lock(root / ".locks", key, say))


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

    There is no lock: two workers that want the same entry both compute it and write the same bytes.
    """

    kind: ClassVar[str] = "store.s3"
    url: str
    endpoint_url: str | None = None
    anonymous: bool = False

    def open(self) -> Backend:
        """The bucket and prefix of ``url``."""
        if not self.url.startswith("s3://"):
            raise BadInput("store.url", found=repr(self.url), needed="s3://bucket/prefix")
        options: dict[str, object] = {"anon": self.anonymous}
        if self.endpoint_url:
            options["client_kwargs"] = {"endpoint_url": self.endpoint_url}
        try:
            store = FsspecStore.from_url(self.url, storage_options=options)
        except ImportError:
            raise BadInput("store", found="s3 without s3fs", needed="pip install 'dzop[s3]'") from None
        return Backend(Answering(store, self.url), self.url, None, lambda key, say: nullcontext())
