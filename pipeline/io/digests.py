"""SHA-256 digests of files. Every cache key is derived from them."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from pipeline.errors import BadInput

_LARGE_BYTES = 1 << 26  # smaller files are hashed again every time


@dataclass(frozen=True)
class DigestCache:
    """Digests of large files on disk, one JSON file each: hashing four gigabytes of weights takes seconds.

    A digest is found again by the file's resolved path, size, inode, mtime and ctime, so a rewritten file is a miss.
    """

    folder: Path

    def load(self, path: Path, stat: os.stat_result) -> str | None:
        """The file's sha256 (hex), None if it is not cached."""
        entry = self._entry(path, stat)
        if not entry.exists():
            return None
        digest = json.loads(entry.read_text()).get("sha256", "")
        return str(digest) if len(digest) == 64 else None

    def save(self, path: Path, stat: os.stat_result, digest: str) -> None:
        """Cache a digest. A folder that cannot be written is ignored: the next run hashes the file again."""
        entry = self._entry(path, stat)
        partial = entry.with_suffix(f".{os.getpid()}.partial")
        try:
            entry.parent.mkdir(parents=True, exist_ok=True)
            partial.write_text(json.dumps({"path": str(path.resolve()), "sha256": digest}))
            partial.replace(entry)
        except OSError:
            return

    def _entry(self, path: Path, stat: os.stat_result) -> Path:
        identity = f"{path.resolve()}\0{stat.st_size}\0{stat.st_ino}\0{stat.st_mtime_ns}\0{stat.st_ctime_ns}"
        return self.folder / f"{sha256(identity.encode()).hexdigest()}.json"


_active_cache: ContextVar[DigestCache | None] = ContextVar("digest_cache", default=None)


@contextmanager
def use_digest_cache(cache: DigestCache | None) -> Iterator[None]:
    """Let ``file_digest`` use this cache inside the block (None: hash every file)."""
    previous = _active_cache.set(cache)
    try:
        yield
    finally:
        _active_cache.reset(previous)


def file_digest(path: Path) -> str:
    """sha256 (hex) of a file's bytes. Raises BadInput when it cannot be read."""
    try:
        stat = path.stat()
        cache = _active_cache.get() if stat.st_size >= _LARGE_BYTES else None
        digest = cache.load(path, stat) if cache else None
        if digest is None:
            digest = _hash(path)
            if cache:
                cache.save(path, stat, digest)
    except (OSError, ValueError) as error:
        found = error.strerror if isinstance(error, OSError) else error
        raise BadInput(path, found=found, needed="a readable file") from None
    return digest


def files_digest(paths: dict[str, Path]) -> str:
    """sha256 (hex) of several files and their names; independent of their order and location."""
    lines = "".join(f"{name}\0{file_digest(path)}\n" for name, path in sorted(paths.items()))
    return sha256(lines.encode()).hexdigest()


def _hash(path: Path) -> str:
    hasher = sha256()
    with path.open("rb") as stream:
        while block := stream.read(1 << 22):
            hasher.update(block)
    return hasher.hexdigest()
