"""Files that are read whole, and that a reader sees whole or not at all."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path
from typing import Any

from pipeline.errors import BadInput, DzopError

IMAGE_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "WEBP", "GIF", "PPM", "TGA")
"""What is opened as an image. Others are not: Pillow hands PostScript to a program that runs what the file says."""


def read_file(path: Path, needed: str) -> bytes:
    """Bytes of a regular file. Raises BadInput for anything else: a pipe or a device would never end."""
    try:
        if path.exists() and not path.is_file():
            raise BadInput(path, found="no regular file", needed=needed)
        return path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the name
        found = "no such file" if isinstance(error, FileNotFoundError) else getattr(error, "strerror", error)
        raise BadInput(path, found=found, needed=needed) from None


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file beside its place and move it there; the folder is made, and nothing half-written stays behind.

    Raises DzopError where there is no room or no right to write.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            partial.write_bytes(content if isinstance(content, bytes) else content.encode())
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        raise cannot_write(path, error) from None


def cannot_write(path: Path, error: OSError) -> DzopError:
    """What to do where a file could not be written."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return DzopError(f"{path}: the disk is full; make room or write elsewhere, then run again")
    return DzopError(f"{path}: cannot be written ({error.strerror}); write elsewhere, then run again")


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file whole. Raises ValueError for a NaN, which JSON does not have."""
    write_whole(path, json.dumps(value, indent=1, allow_nan=False))
