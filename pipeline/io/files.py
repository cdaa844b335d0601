"""Read regular files and write them atomically."""

from __future__ import annotations

import errno
import json
import os
import secrets
from pathlib import Path
from typing import Any

from pipeline.errors import BadInput, DzopError
from pipeline.io.digests import file_exists, record_content

IMAGE_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "WEBP", "GIF", "PPM", "TGA")
"""The only formats opened as images. Pillow runs PostScript files through an external interpreter, so they stay out."""


def read_file(path: Path, needed: str) -> bytes:
    """Bytes of a regular file. Raises BadInput for pipes and devices, since reading them may never end.

    Inside ``track_files``, raises FileChanged if the run has hashed or read other content of this file before.
    """
    try:
        if file_exists(path) and not path.is_file():
            raise BadInput(path, found=describe_irregular(path), needed=needed)
        content = path.read_bytes()
        record_content(path, content)
        return content
    except (OSError, ValueError) as error:  # ValueError: a NUL byte in the name
        found = "no such file" if isinstance(error, FileNotFoundError) else getattr(error, "strerror", error)
        raise BadInput(path, found=found, needed=needed) from None


def describe_irregular(path: Path) -> str:
    """What kind of path this is instead of a regular file."""
    return "a folder" if path.is_dir() else "not a regular file"


def write_atomic(path: Path, content: str | bytes) -> None:
    """Write a file atomically through a temporary sibling file; missing parent folders are created.

    A reader sees all of the old content or all of the new. Raises DzopError when the disk is full or read-only.
    """
    partial = path.with_name(f".{path.name}.{unique_suffix()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            partial.write_bytes(content if isinstance(content, bytes) else content.encode())
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        raise write_error(path, error) from None


def unique_suffix() -> str:
    """Part of a temporary file's name that no other writer has: threads share a process id, and containers may."""
    return f"{os.getpid()}-{secrets.token_hex(4)}"


def write_error(path: Path, error: OSError) -> DzopError:
    """The error to raise if writing ``path`` failed, with the cause and what to do."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return DzopError(f"{path}: the disk is full; make room or write elsewhere, then run again")
    return DzopError(f"{path}: cannot be written ({error.strerror}); write elsewhere, then run again")


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file atomically. Raises ValueError for NaN and infinity, which JSON cannot represent."""
    write_atomic(path, json.dumps(value, indent=1, allow_nan=False))
