"""Several meshes -> one, with their textures in a common atlas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from pipeline.errors import BadInput
from pipeline.functional.shading import DEFAULT_GREY
from pipeline.io.meshes.checks import check_uv
from pipeline.io.meshes.corners import split_vertices
from pipeline.items.objects import Mesh

_MAX_TEXTURE_PX = 16384
_GUTTER_PX = 8  # border around each texture in an atlas: enough for a minification by 8


def join_meshes(path: Path, parts: Sequence[Mesh]) -> Mesh:
    """Several meshes as one. If one has a texture, all get one: in a common atlas, colours as single texels.

    Raises BadInput, naming ``path``, for textures that do not fit an atlas.
    """
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
    )


def _vertex_colours(part: Mesh) -> UInt8[np.ndarray, "v 3"]:
    """The mesh's vertex colours, grey where it has none."""
    if part.colours is not None:
        return part.colours
    return np.full((len(part.vertices), 3), DEFAULT_GREY, dtype=np.uint8)


def _bake_colours(part: Mesh) -> Mesh:
    """The mesh with a texture in place of colours: a square palette; each face takes the texel of its mean colour."""
    mean = np.rint(_vertex_colours(part)[part.faces].mean(axis=1)).astype(np.uint8)
    palette, entry = np.unique(mean, axis=0, return_inverse=True)
    size = int(np.ceil(len(palette) ** 0.5))
    texture = np.zeros((size * size, 3), dtype=np.uint8)
    texture[: len(palette)] = palette
    row, column = np.divmod(entry.reshape(-1), size)
    uv = np.stack([(column + 0.5) / size, 1 - (row + 0.5) / size], axis=-1)
    vertices, faces, uv = split_vertices(part.vertices, part.faces, np.repeat(uv[:, None], 3, axis=1))
    return Mesh(vertices, faces, uv=uv, texture=texture.reshape(size, size, 3))


def _share_atlas(path: Path, parts: Sequence[Mesh]) -> list[Mesh]:
    """The meshes with one common texture: theirs stacked from top to bottom, repeats written out."""
    tiled = [_tile(path, part) for part in parts]
    # each texture continues into its gutter as a repeat would, so that neighbours do not bleed into it
    gutter = ((_GUTTER_PX, _GUTTER_PX), (_GUTTER_PX, _GUTTER_PX), (0, 0))
    padded = [np.pad(texture, gutter, mode="wrap") for _, texture in tiled]
    height, width = sum(texture.shape[0] for texture in padded), max(texture.shape[1] for texture in padded)
    if max(height, width) > _MAX_TEXTURE_PX:
        found = f"textures that make an atlas of {width} x {height}"
        raise BadInput(path, found=found, needed=f"at most {_MAX_TEXTURE_PX} pixels a side; bake them into one")
    atlas = np.zeros((height, width, 3), dtype=np.uint8)
    placed, top = [], 0
    for part, block, (uv, texture) in zip(parts, padded, tiled, strict=True):
        h, w = texture.shape[:2]
        atlas[top : top + len(block), : block.shape[1]] = block
        x, y = _GUTTER_PX + uv[:, 0] * w, top + _GUTTER_PX + (1 - uv[:, 1]) * h
        placed.append(replace(part, uv=np.stack([x / width, 1 - y / height], axis=-1), texture=atlas))
        top += len(block)
    return placed


def _tile(path: Path, part: Mesh) -> tuple[Float[np.ndarray, "v 2"], UInt8[np.ndarray, "H W 3"]]:
    """Texture coordinates within 0..1, and the texture repeated as often as the original coordinates repeat it."""
    assert part.uv is not None
    assert part.texture is not None
    check_uv(path, part)
    low = np.floor(part.uv.min(axis=0) + 1e-6)
    times = np.maximum(np.ceil(part.uv.max(axis=0) - 1e-6) - low, 1)
    if (times[::-1] * part.texture.shape[:2]).max() > _MAX_TEXTURE_PX:
        found = f"a texture repeated {times[0]:.0f} x {times[1]:.0f} times"
        raise BadInput(path, found=found, needed="one texture without repeats; bake it")
    return (part.uv - low) / times, np.tile(part.texture, (int(times[1]), int(times[0]), 1))
