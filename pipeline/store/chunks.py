"""Rows of an array straight from the store's bytes, where its chunks are no more than bytes and a checksum.

Zarr's own pipeline takes half a millisecond for each chunk and copies it three times; here a chunk is read into the
row it becomes, and its crc32c is compared there. The format on disk is Zarr's all the same.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
import zarr

_CRC = 4  # bytes at a chunk's end


def plain(array: zarr.Array) -> bool:
    """Whether each row is one chunk of little-endian bytes and a crc32c, and nothing else."""
    codecs: Any = array.metadata.to_dict().get("codecs", ())
    names = [codec["name"] for codec in codecs]
    whole = array.chunks == (1, *array.shape[1:]) and bool(np.prod(array.shape))
    return (
        hasattr(os, "preadv")
        and whole
        and names == ["bytes", "crc32c"]
        and array.dtype.newbyteorder("<") == array.dtype
    )


def read_rows(folder: Path, array: zarr.Array, rows: Sequence[int]) -> np.ndarray:
    """Values of some rows of an array below a folder. Raises OSError or ValueError for a chunk that is not whole."""
    values = np.empty((len(rows), *array.shape[1:]), dtype=array.dtype)
    into, tail, below = values.reshape(len(rows), -1).view(np.uint8), (0,) * (array.ndim - 1), f"{folder / array.path}/"
    for k, row in enumerate(rows):
        _read_chunk(below + array.metadata.encode_chunk_key((row, *tail)), into[k])
    return values


def _read_chunk(path: str, into: np.ndarray) -> None:
    stored, beyond = bytearray(_CRC), bytearray(1)
    file = os.open(path, os.O_RDONLY)
    try:
        size = os.preadv(file, [into.data, stored, beyond], 0)
    finally:
        os.close(file)
    if size != len(into) + _CRC:
        raise ValueError(f"a chunk has not the {len(into) + _CRC} bytes that were written")
    if google_crc32c.value(into) != int.from_bytes(stored, "little"):
        raise ValueError("a chunk's crc32c is not the one that was stored")
