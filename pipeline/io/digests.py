"""Digests of files, the leaves of every key."""

from __future__ import annotations

import json
import os
from hashlib import sha256
from pathlib import Path

from pipeline.errors import BadInput

_memo_folder: Path | None = None
_LARGE = 1 << 26  # bytes; smaller files are simply read again


def remember_in(folder: Path | None) -> None:
    """Keep the digests of large files in ``folder`` (None: nowhere), by path, size, inode and change times.

    Four gigabytes of weights take seconds to hash; a file that was written since has another mtime or ctime.
    """
    global _memo_folder
    _memo_folder = folder


def file_digest(path: Path) -> str:
    """sha256 (hex) of a file's bytes. Raises BadInput when it cannot be read."""
    try:
        stat = path.stat()
        memo = _memo(path, stat) if stat.st_size >= _LARGE else None
        if memo is not None and memo.exists():
            kept = json.loads(memo.read_text())
            if len(kept.get("sha256", "")) == 64:
                return str(kept["sha256"])
        hasher = sha256()
        with path.open("rb") as stream:
            while block := stream.read(1 << 22):
                hasher.update(block)
    except (OSError, ValueError) as error:
        found = error.strerror if isinstance(error, OSError) else error
        raise BadInput(path, found=found, needed="a readable file") from None
    if memo is not None:
        _write(memo, {"path": str(path.resolve()), "sha256": hasher.hexdigest()})
    return hasher.hexdigest()


def files_digest(paths: dict[str, Path]) -> str:
    """sha256 of several files under their names, whatever their order or place."""
    lines = "".join(f"{name}\0{file_digest(path)}\n" for name, path in sorted(paths.items()))
    return sha256(lines.encode()).hexdigest()


def _memo(path: Path, stat: os.stat_result) -> Path | None:
    if _memo_folder is None:
        return None
    identity = f"{path.resolve()}\0{stat.st_size}\0{stat.st_ino}\0{stat.st_mtime_ns}\0{stat.st_ctime_ns}"
    return _memo_folder / f"{sha256(identity.encode()).hexdigest()}.json"


def _write(memo: Path, value: dict[str, str]) -> None:
    try:
        memo.parent.mkdir(parents=True, exist_ok=True)
        partial = memo.with_suffix(f".{os.getpid()}.partial")
        partial.write_text(json.dumps(value))
        partial.replace(memo)
    except OSError:
        return  # a read-only place costs the next run some seconds, nothing else
