"""Several meshes -> one, with their textures in a common atlas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image

from pipeline.errors import BadInput
from pipeline.functional.shading import DEFAULT_GREY
from pipeline.io.meshes.checks import check_uv
from pipeline.io.meshes.corners import split_vertices
from pipeline.items.objects import Mesh

_MAX_SIDE_PX = 16384
_MAX_ATLAS_PX = 1 << 27  # 400 MB; textures of a larger atlas are halved until they fit
_MIN_SIDE_PX = 16  # smaller textures are not halved
_GUTTER_PX = 8  # border around each texture in an atlas, wide enough for minification by 8


def join_meshes(path: Path, parts: Sequence[Mesh]) -> Mesh:
    """Several meshes as one. If any has a texture, all share an atlas, in which plain colours become single texels.

    Meshes with the same texture (the same array) share its place. Raises BadInput, naming ``path``, for textures that
    do not fit.
    """
    if len(parts) == 1:
        return parts[0]
    if any(part.texture is not None for part in parts):
        parts = _share_atlas(path, [part if part.texture is not None else _bake_colours(part) for part in parts])
    elif any(part.colours is not None for part in parts):
        parts = [replace(part, colours=_vertex_colours(part)) for part in parts]
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])

    def concatenate(field: str) -> Any:
        values = [getattr(part, field) for part in parts]
        return None if values[0] is None else np.concatenate(values)

    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)]),
        colours=concatenate("colours"),
        uv=concatenate("uv"),
        texture=parts[0].texture,
        warnings=tuple(dict.fromkeys(warning for part in parts for warning in part.warnings)),
    )


def _vertex_colours(part: Mesh) -> UInt8[np.ndarray, "v 3"]:
    """The mesh's vertex colours, grey where it has none."""
    if part.colours is not None:
        return part.colours
    return np.full((len(part.vertices), 3), DEFAULT_GREY, dtype=np.uint8)


def _bake_colours(part: Mesh) -> Mesh:
    """The mesh with colours replaced by a texture: a square palette with a texel for each face's mean colour."""
    mean = np.rint(_vertex_colours(part)[part.faces].mean(axis=1)).astype(np.int64)
    codes, entry = np.unique(mean @ [1 << 16, 1 << 8, 1], return_inverse=True)
    size = int(np.ceil(len(codes) ** 0.5))
    texture = np.zeros((size * size, 3), dtype=np.uint8)
    texture[: len(codes)] = (codes[:, None] >> [16, 8, 0]) & 255
    row, column = np.divmod(entry.reshape(-1), size)
    uv = np.stack([(column + 0.5) / size, 1 - (row + 0.5) / size], axis=-1)
    vertices, faces, uv = split_vertices(part.vertices, part.faces, np.repeat(uv[:, None], 3, axis=1))
    return replace(part, vertices=vertices, faces=faces, colours=None, uv=uv, texture=texture.reshape(size, size, 3))


def _share_atlas(path: Path, parts: Sequence[Mesh]) -> list[Mesh]:
    """The meshes with one common texture, in which theirs lie side by side with repeats expanded."""
    textures = {id(part.texture): part.texture for part in parts if part.texture is not None}
    lows, times = _measure_repeats(path, parts)
    halved = 0
    while True:
        sizes = {key: np.array(texture.shape[:2]) * times[key][::-1] for key, texture in textures.items()}
        corners, (height, width) = _pack({key: size + 2 * _GUTTER_PX for key, size in sizes.items()})
        if max(height, width) <= _MAX_SIDE_PX and height * width <= _MAX_ATLAS_PX:
            break
        large = [key for key, texture in textures.items() if min(texture.shape[:2]) >= 2 * _MIN_SIDE_PX]
        if not large:
            found = f"textures that make an atlas of {width} x {height}, repeats written out"
            raise BadInput(path, found=found, needed=f"at most {_MAX_SIDE_PX} pixels a side; bake them into one")
        textures |= {key: np.asarray(Image.fromarray(textures[key]).reduce(2)) for key in large}
        halved += 1
    atlas = np.zeros((height, width, 3), dtype=np.uint8)
    for key, (top, left) in corners.items():
        # each texture is repeated into its gutter, so that neighbours do not bleed into it
        gutter = ((_GUTTER_PX, _GUTTER_PX), (_GUTTER_PX, _GUTTER_PX), (0, 0))
        block = np.pad(np.tile(textures[key], (times[key][1], times[key][0], 1)), gutter, mode="wrap")
        atlas[top : top + block.shape[0], left : left + block.shape[1]] = block
    notes = (f"its textures are reduced to 1/{2**halved} of their size to fit one image",) if halved else ()
    placed = []
    for part, low in zip(parts, lows, strict=True):
        key = id(part.texture)
        uv = (part.uv - low) / times[key]
        offset = np.array(corners[key]) + _GUTTER_PX
        x, y = offset[1] + uv[:, 0] * sizes[key][1], offset[0] + (1 - uv[:, 1]) * sizes[key][0]
        uv = np.stack([x / width, 1 - y / height], axis=-1)
        placed.append(replace(part, uv=uv, texture=atlas, warnings=part.warnings + notes))
    return placed


def _measure_repeats(
    path: Path, parts: Sequence[Mesh]
) -> tuple[list[Float[np.ndarray, " 2"]], dict[int, Int[np.ndarray, " 2"]]]:
    """Lowest tile that each mesh uses, and how often each texture must repeat along x and y, by its id."""
    lows: list[Float[np.ndarray, " 2"]] = []
    times: dict[int, Int[np.ndarray, " 2"]] = {}
    for part in parts:
        assert part.uv is not None
        check_uv(path, part)
        low = np.floor(part.uv.min(axis=0) + 1e-6)
        span = np.maximum(np.ceil(part.uv.max(axis=0) - 1e-6) - low, 1)
        if span.max() > _MAX_SIDE_PX:
            found = f"a texture repeated {span[0]:.0f} x {span[1]:.0f} times"
            raise BadInput(path, found=found, needed="one texture without repeats; bake it")
        lows.append(low)
        key = id(part.texture)
        times[key] = np.maximum(times.get(key, 1), span.astype(np.int64))
    return lows, times


def _pack(sizes: dict[int, Int[np.ndarray, " 2"]]) -> tuple[dict[int, tuple[int, int]], tuple[int, int]]:
    """Corners (top, left) of rectangles (h, w) packed in rows of descending height, and the total size."""
    area = sum(int(h) * int(w) for h, w in sizes.values())
    width = min(max(int(area**0.5), *(int(w) for _, w in sizes.values())), 4 * _MAX_SIDE_PX)
    corners, top, left, row_height, used = {}, 0, 0, 0, 0
    for key, (h, w) in sorted(sizes.items(), key=lambda item: -int(item[1][0])):
        if left and left + w > width:
            top, left, row_height = top + row_height, 0, 0
        corners[key] = (top, left)
        left, row_height = left + int(w), max(row_height, int(h))
        used = max(used, left)
    return corners, (top + row_height, used)
