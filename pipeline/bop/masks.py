"""COCO run-length encoding (RLE) of masks: column-major runs, background first, as a list or a compressed string."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool
from pycocotools import mask as coco


def encode_rle(mask: Bool[np.ndarray, "H W"]) -> dict[str, Any]:
    """Compressed RLE {"size": [h, w], "counts": str} of a mask."""
    rle = coco.encode(np.asfortranarray(mask, dtype=np.uint8))
    return {"size": [int(n) for n in rle["size"]], "counts": rle["counts"].decode("ascii")}


def decode_rle(rle: dict[str, Any]) -> Bool[np.ndarray, "H W"]:
    """The mask of an RLE made by ``encode_rle`` or ``read_rle``; the input is not checked."""
    return coco.decode(rle).astype(bool)


def read_rle(segmentation: Any, size_hw: tuple[int, int]) -> dict[str, Any]:
    """A segmentation from a file, validated and as ``encode_rle`` returns it. ``size_hw``: size of the image.

    Accepts uncompressed ``counts`` (a list, as CNOS writes) and compressed ones (a string). Raises ValueError, in one
    line, for anything else, for another size, and for runs that do not cover the image: pycocotools does not check
    them and would read past its buffers.
    """
    if not isinstance(segmentation, dict) or not {"size", "counts"} <= segmentation.keys():
        raise ValueError("segmentation is not an RLE with size and counts")
    size, counts = segmentation["size"], segmentation["counts"]
    if size != list(size_hw):
        raise ValueError(f"mask of {size} where the image is {list(size_hw)} (height, width)")
    runs = _decompress(counts) if isinstance(counts, str) else counts
    if not isinstance(runs, list) or not all(type(run) is int and run >= 0 for run in runs):
        raise ValueError("RLE counts are not a list of integers >= 0 or a compressed string")
    h, w = size_hw
    if sum(runs) != h * w:
        raise ValueError(f"RLE counts cover {sum(runs)} pixels, the image has {h * w}")
    return encode_rle(_runs_to_mask(runs, h, w))


def to_uncompressed(rle: dict[str, Any]) -> dict[str, Any]:
    """The RLE with its counts as a list, as in BOP's files. ``rle``: from ``encode_rle`` or ``read_rle``."""
    return {"size": rle["size"], "counts": _decompress(rle["counts"])}


def rle_area(rle: dict[str, Any]) -> int:
    """Number of pixels in the mask. ``rle``: from ``encode_rle`` or ``read_rle``."""
    return int(coco.area(rle))


def _runs_to_mask(runs: list[int], h: int, w: int) -> Bool[np.ndarray, "H W"]:
    inside = np.arange(len(runs)) % 2 == 1
    return np.repeat(inside, runs).reshape(w, h).T


def _decompress(text: str) -> list[int]:
    """Runs of COCO's compressed string: 5 bits per character, little-endian, as differences to the run two before."""
    runs: list[int] = []
    value, shift = 0, 0
    for character in text:
        bits = ord(character) - 48
        if not 0 <= bits < 64 or shift > 60:
            raise ValueError("RLE counts are not a compressed string of COCO")
        value |= (bits & 31) << shift
        shift += 5
        if bits & 32:
            continue
        value -= (1 << shift) if bits & 16 else 0
        runs.append(value + runs[-2] if len(runs) > 2 else value)
        value, shift = 0, 0
    if shift:
        raise ValueError("RLE counts end in the middle of a number")
    return runs
