"""COCO's encodings of masks: polygons, and run-length encoding (RLE) as a list or a compressed string.

Runs are column-major, background first.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from pycocotools import mask as coco

from pipeline.bop.jsonio import is_number
from pipeline.functional.boxes import pixels_inside


def encode_rle(mask: Bool[np.ndarray, "H W"]) -> dict[str, Any]:
    """Compressed RLE {"size": [h, w], "counts": str} of a mask."""
    rle = coco.encode(np.asfortranarray(mask, dtype=np.uint8))
    return {"size": [int(n) for n in rle["size"]], "counts": rle["counts"].decode("ascii")}


def decode_rle(rle: dict[str, Any]) -> Bool[np.ndarray, "H W"]:
    """The mask of an RLE made by ``encode_rle`` or ``read_rle``; the input is not checked."""
    return coco.decode(rle).astype(bool)


def pixels_of(
    rle: dict[str, Any] | None, bbox_xyxy: tuple[float, float, float, float], size_hw: tuple[int, int]
) -> Bool[np.ndarray, "H W"]:
    """The pixels of a detection: of its mask as ``encode_rle`` returns it, or of its box if it has none."""
    if rle is not None:
        return decode_rle(rle)
    inside = np.zeros(size_hw, dtype=bool)
    inside[pixels_inside(bbox_xyxy, size_hw)] = True
    return inside


def read_segmentation(segmentation: Any, size_hw: tuple[int, int]) -> dict[str, Any] | None:
    """The mask of an entry as ``encode_rle`` returns it: from an RLE or polygons; None for null and an empty list.

    Raises ValueError, in one line, for anything else.
    """
    if segmentation is None or segmentation == []:
        return None
    return draw_polygons(segmentation, size_hw) if isinstance(segmentation, list) else read_rle(segmentation, size_hw)


def draw_polygons(polygons: list[Any], size_hw: tuple[int, int]) -> dict[str, Any]:
    """The union of COCO's polygons, as ``encode_rle`` returns it.

    Each polygon is a list [x, y, x, y, ...] in pixels. A single polygon may be such a list itself, or a list of points
    [[x, y], ...]. Raises ValueError for anything else, and for corners given as fractions of the image size.
    """
    arrays = _parse_polygons(polygons, size_hw)
    if all(((array >= 0) & (array <= 1)).all() for array in arrays):
        raise ValueError("polygons have corners from 0 to 1, not in pixels")
    edges = sum(float(np.abs(np.diff(array.reshape(-1, 2), axis=0)).sum()) for array in arrays)
    if edges > 4 * size_hw[0] * size_hw[1]:  # pycocotools allocates memory for every pixel of every edge
        raise ValueError(f"polygons have edges of {edges:.3g} pixels in total, too many for the image")
    rle = coco.merge(coco.frPyObjects([array.tolist() for array in arrays], *size_hw))
    return encode_rle(coco.decode(rle).astype(bool))


def polygon_corners(segmentation: Any, size_hw: tuple[int, int]) -> Float[np.ndarray, "n 2"] | None:
    """Corners (x, y) of all polygons of an entry; None for an entry without polygons. Raises ValueError."""
    if not isinstance(segmentation, list) or not segmentation:
        return None
    return np.concatenate(_parse_polygons(segmentation, size_hw)).reshape(-1, 2)


def _parse_polygons(polygons: list[Any], size_hw: tuple[int, int]) -> list[np.ndarray]:
    if all(is_number(value) for value in polygons):
        polygons = [polygons]
    elif all(isinstance(point, list) and len(point) == 2 for point in polygons):
        polygons = [[value for point in polygons for value in point]]
    return [_parse_polygon(polygon, size_hw) for polygon in polygons]


def _parse_polygon(polygon: Any, size_hw: tuple[int, int]) -> np.ndarray:
    if not isinstance(polygon, list) or not all(is_number(value) for value in polygon):
        raise ValueError("segmentation is neither an RLE with size and counts nor polygons [[x, y, x, y, ...], ...]")
    if len(polygon) < 6 or len(polygon) % 2:
        raise ValueError(f"polygon has {len(polygon)} numbers, not x and y of three or more corners")
    array, longer = np.array(polygon, dtype=np.float64), max(size_hw)
    if not (np.abs(array) <= 2 * longer).all():  # also false for NaN and infinity
        raise ValueError(f"polygon has corners far outside the image of {size_hw[1]} x {size_hw[0]} (width x height)")
    return array


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


def rle_bbox(rle: dict[str, Any]) -> tuple[float, float, float, float]:
    """Box (x, y, width, height) around the mask; zeros for an empty mask. ``rle``: as for ``rle_area``."""
    x, y, w, h = (float(value) for value in coco.toBbox(rle))
    return x, y, w, h


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
