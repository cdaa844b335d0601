"""SHA-256 digests of files, the basis of all cache keys, and detection of files that change during a run.

A file is hashed for a key at one moment and read at another. Inside ``track_files``, a file's digest is fixed at first
use, whether it was hashed or read (``io.files.read_file``). Any later difference raises FileChanged, so that a result
of new content is never stored under a key of the old content. Libraries that open files themselves are called inside
``unchanged_files``.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path

from pipeline.errors import BadInput, DzopError

_LARGE_BYTES = 1 << 26  # digests of smaller files are not cached on disk
# Two writes within one tick of a file system's clock have the same times: up to 2 s on FAT, 1 s on some NFS.
_SETTLED_NS = 2_500_000_000
_ABSENT = "no such file"


class FileChanged(DzopError):
    """A file changed after the run had hashed or read it."""

    def __init__(self, path: str) -> None:
        super().__init__(
            f"{path}: found a file that changed during the run, needs one that no one writes to; run again"
        )


@dataclass(frozen=True)
class FileState:
    """Attributes that change on every write. ``settled``: old enough that a later write has another time."""

    size: int
    inode: int
    mtime_ns: int
    ctime_ns: int
    settled: bool

    @classmethod
    def of(cls, path: str) -> FileState:
        """The file's state now. Raises OSError."""
        now, stat = time.time_ns(), os.stat(path)
        settled = stat.st_ctime_ns < now - _SETTLED_NS  # the kernel sets the ctime; programs can set the mtime
        return cls(stat.st_size, stat.st_ino, stat.st_mtime_ns, stat.st_ctime_ns, settled)

    def is_same(self, before: FileState) -> bool:
        """Whether the file is unchanged since ``before``; only certain if that was settled."""
        now = (self.size, self.inode, self.mtime_ns, self.ctime_ns)
        return now == (before.size, before.inode, before.mtime_ns, before.ctime_ns)


@dataclass(frozen=True)
class DigestCache:
    """Disk cache of digests of large files, one JSON file each: hashing four gigabytes of weights takes seconds.

    Digests are looked up by resolved path, size, inode, mtime and ctime, so a rewritten file is a miss; values derived
    from files are looked up by the files' digests.
    """

    folder: Path

    def load(self, identity: str) -> str | None:
        """The sha256 (hex) cached for an identity, None if it is missing or damaged."""
        try:
            entry = json.loads(self._entry(identity).read_text())
            digest = str(entry["sha256"])
            return digest if entry["check"] == _check(identity, digest) else None
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return None

    def save(self, identity: str, digest: str, path: Path) -> None:
        """Cache a digest. Does nothing if the folder is not writable; the next run then hashes the file again."""
        entry = self._entry(identity)
        partial = entry.with_suffix(f".{os.getpid()}.partial")
        record = {"path": str(path.resolve()), "sha256": digest, "check": _check(identity, digest)}
        try:
            entry.parent.mkdir(parents=True, exist_ok=True)
            partial.write_text(json.dumps(record))
            partial.replace(entry)
        except OSError:
            return

    def _entry(self, identity: str) -> Path:
        return self.folder / f"{sha256(identity.encode()).hexdigest()}.json"


def _identity(path: Path, state: FileState) -> str:
    return f"{path.resolve()}\0{state.size}\0{state.inode}\0{state.mtime_ns}\0{state.ctime_ns}"


def _check(identity: str, digest: str) -> str:
    """Checksum of a cached digest, which exposes files truncated or zeroed by a power failure."""
    return sha256(f"{identity}\0{digest}".encode()).hexdigest()


@dataclass(eq=False)
class TrackedFiles:
    """Digests of the files that a run has used, by absolute path; ``_ABSENT`` for missing ones.

    ``cache`` keeps digests of large files between runs; None disables it.
    """

    cache: DigestCache | None = None
    digests: dict[str, str] = field(default_factory=dict)
    _states: dict[str, FileState] = field(default_factory=dict, repr=False)

    def digest(self, path: Path) -> str:
        """sha256 (hex) of the file. Raises FileChanged, and OSError where it cannot be read."""
        name = os.path.abspath(path)
        try:
            state = FileState.of(name)
        except FileNotFoundError:
            self.record(name, _ABSENT)
            raise
        known = self._states.get(name)
        if known is None or not known.settled or not state.is_same(known):
            self.record(name, _digest_of(path, state, self.cache))
            self._states[name] = state
        return self.digests[name]

    def record(self, name: str, digest: str) -> None:
        """Record the digest of a file. Raises FileChanged if it differs from the one recorded."""
        if self.digests.setdefault(name, digest) != digest:
            raise FileChanged(name)

    @contextmanager
    def unchanged(self, paths: Sequence[Path] | None) -> Iterator[None]:
        """As ``unchanged_files``."""
        names = list(self.digests) if paths is None else [os.path.abspath(path) for path in paths]
        known = [name for name in names if self.digests.get(name, _ABSENT) != _ABSENT]
        before = {name: self._verify(name) for name in known}
        yield
        for name, state in before.items():
            if not self._verify(name).is_same(state):
                raise FileChanged(name)

    def _verify(self, name: str) -> FileState:
        """The state of a file, once its digest is confirmed. Raises FileChanged."""
        try:
            state = FileState.of(name)
            self.digest(Path(name))
        except OSError:
            raise FileChanged(name) from None
        return state


_tracked: TrackedFiles | None = None


@contextmanager
def track_files(cache: DigestCache | None = None, known: Mapping[str, str] | None = None) -> Iterator[TrackedFiles]:
    """Track the files of one run. ``known``: digests by absolute path, recorded by another process of this run.

    A nested block joins the outer one.
    """
    global _tracked
    if _tracked is not None:
        _tracked.cache = _tracked.cache or cache
        yield _tracked
        return
    _tracked = TrackedFiles(cache, dict(known or {}))
    try:
        yield _tracked
    finally:
        _tracked = None


def tracked_digests() -> dict[str, str]:
    """Digests recorded so far, by absolute path; empty outside ``track_files``."""
    return {} if _tracked is None else dict(_tracked.digests)


@contextmanager
def unchanged_files(paths: Sequence[Path] | None = None) -> Iterator[None]:
    """Raise FileChanged if a file (None: any file used so far) has changed since its first use or does so in the block.

    Files that were neither hashed nor read before are not checked; outside ``track_files``, none are.
    """
    if _tracked is None:
        yield
        return
    with _tracked.unchanged(paths):
        yield


def record_content(path: Path, content: bytes) -> None:
    """Record a file's content that was read. Raises FileChanged if a key was made from other content."""
    if _tracked is not None:
        _tracked.record(os.path.abspath(path), sha256(content).hexdigest())


def file_exists(path: Path) -> bool:
    """Whether the file exists. Raises FileChanged if that has changed since the last call.

    Use this where a missing file is no error but changes results.
    """
    exists = path.exists()
    if _tracked is not None:
        name = os.path.abspath(path)
        if not exists:
            _tracked.record(name, _ABSENT)
        elif _tracked.digests.get(name) == _ABSENT:
            raise FileChanged(name)
    return exists


def file_digest(path: Path) -> str:
    """sha256 (hex) of a file's bytes. Raises BadInput when it cannot be read, FileChanged inside ``track_files``."""
    try:
        return _digest_of(path, FileState.of(str(path)), None) if _tracked is None else _tracked.digest(path)
    except (OSError, ValueError) as error:
        found = getattr(error, "strerror", error)
        folder = isinstance(error, IsADirectoryError)
        raise BadInput(path, found="a folder" if folder else found, needed="a readable file") from None


def files_digest(paths: Mapping[str, Path]) -> str:
    """sha256 (hex) of several files with their names, independent of order and location."""
    lines = "".join(f"{name}\0{file_digest(path)}\n" for name, path in sorted(paths.items()))
    return sha256(lines.encode()).hexdigest()


def derived_digest(kind: str, paths: Mapping[str, Path], compute: Callable[[], str]) -> str:
    """``compute()``, a digest derived from files. For large files it is cached on disk, looked up by their digests.

    ``kind``: what is computed, and its version. Raises as ``file_digest``.
    """
    identity = f"{kind}\0{files_digest(paths)}"
    is_large = any(path.stat().st_size >= _LARGE_BYTES for path in paths.values())
    cache = _tracked.cache if _tracked is not None and is_large else None
    found = cache.load(identity) if cache else None
    if found is not None:
        return found
    with unchanged_files([*paths.values()]):
        digest = compute()
    if cache:
        cache.save(identity, digest, next(iter(paths.values())))
    return digest


def _digest_of(path: Path, state: FileState, cache: DigestCache | None) -> str:
    """sha256 (hex) of a file. Those of large files are cached once the files are settled."""
    usable = cache if cache and state.settled and state.size >= _LARGE_BYTES else None
    found = usable.load(_identity(path, state)) if usable else None
    if found is not None:
        return found
    hasher = sha256()
    with path.open("rb") as stream:
        while block := stream.read(1 << 22):
            hasher.update(block)
    digest = hasher.hexdigest()
    if usable and FileState.of(str(path)).is_same(state):
        usable.save(_identity(path, state), digest, path)
    return digest
