"""COCO run-length encoded masks: column-major runs, starting with background, as a list or a compressed string."""

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
    """The mask of an RLE made by ``encode`` or ``read_rle``; others are not checked here."""
    return coco.decode(rle).astype(bool)


def read_rle(segmentation: Any, size_hw: tuple[int, int]) -> dict[str, Any]:
    """A file's segmentation of an image of ``size_hw``, as ``encode`` gives it.

    Accepts uncompressed ``counts`` (list, as CNOS writes) and compressed ones (string). Raises ValueError with one line
    for anything else, for another size, and for runs that do not cover the image: pycocotools checks none of
    this and would read past its buffers.
    """
    if not isinstance(segmentation, dict) or not {"size", "counts"} <= segmentation.keys():
        raise ValueError("segmentation is not an RLE with size and counts")
    size, counts = segmentation["size"], segmentation["counts"]
    if size != list(size_hw):
        raise ValueError(f"mask of {size} where the image is {list(size_hw)} (height, width)")
    runs = _uncompressed(counts) if isinstance(counts, str) else counts
    if not isinstance(runs, list) or not all(type(run) is int and run >= 0 for run in runs):
        raise ValueError("RLE counts are not a list of integers >= 0 or a compressed string")
    h, w = size_hw
    if sum(runs) != h * w:
        raise ValueError(f"RLE counts cover {sum(runs)} pixels, the image has {h * w}")
    return encode_rle(_fill(runs, h, w))


def to_uncompressed(rle: dict[str, Any]) -> dict[str, Any]:
    """An RLE made here with its counts as a list, as BOP's files have it."""
    return {"size": rle["size"], "counts": _uncompressed(rle["counts"])}


def rle_area(rle: dict[str, Any]) -> int:
    """Pixels inside the mask of an RLE made here."""
    return int(coco.area(rle))


def _fill(runs: list[int], h: int, w: int) -> Bool[np.ndarray, "H W"]:
    inside = np.arange(len(runs)) % 2 == 1
    return np.repeat(inside, runs).reshape(w, h).T


def _uncompressed(text: str) -> list[int]:
    """Runs of a compressed string: 5 bits a character, little end first, differences to the run two before (COCO)."""
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
