"""Surface -> colour: normals with creases, mipmapped textures and one headlight. Used by both renderers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.functional.arrays import rank_rows

DEFAULT_GREY = 178  # grey level (0..255) of a mesh without colours


def face_normals(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "f 3"]:
    """Face normals; their length is twice the face's area (mm^2)."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def corner_normals(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], *, crease_deg: float
) -> Float[np.ndarray, "f 3 3"]:
    """Unit normals at each face's corners: smooth, or the face normal where the two differ by more than the crease.

    The smooth normal is the mean over the faces at the corner's position (so copies of a vertex on a texture seam
    count), weighted by their angle there (Thürmer and Wüthrich, JGT 1998), which makes it independent of how quads are
    split. ``crease_deg`` 0 gives flat shading, 180 smooth shading everywhere; a box needs less than 45.
    """
    flat = _normalize(face_normals(vertices, faces))
    corner = rank_rows(list(vertices.T))[faces]
    weights = (corner_angles(vertices, faces)[..., None] * flat[:, None]).reshape(-1, 3)
    count = int(corner.max()) + 1
    smooth = np.stack([np.bincount(corner.reshape(-1), weights[:, axis], count) for axis in range(3)], axis=-1)
    at_corner, of_face = _normalize(smooth)[corner], flat[:, None]
    is_smooth = (at_corner * of_face).sum(-1, keepdims=True) >= np.cos(np.radians(crease_deg))
    return np.where(is_smooth & (crease_deg > 0), at_corner, of_face)


def corner_angles(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "f 3"]:
    """Interior angles of each face at its corners, radians."""
    corner = vertices[faces]
    to_next, to_last = _normalize(np.roll(corner, -1, axis=1) - corner), _normalize(np.roll(corner, 1, axis=1) - corner)
    return np.arccos(np.clip((to_next * to_last).sum(-1), -1, 1))


def _normalize(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)


def shade(
    albedo: Float[np.ndarray, "*n 3"],
    normal: Float[np.ndarray, "*n 3"],
    to_light: Float[np.ndarray, "*n 3"],
    *,
    ambient: float,
    diffuse: float,
) -> Float[np.ndarray, "*n 3"]:
    """Colours: albedo (ambient + diffuse |cos|), two-sided Lambert shading. Vectors need not have unit length."""
    cos = np.abs(_dot(normal, to_light))
    squares = _dot(normal, normal) * _dot(to_light, to_light)
    gain = ambient + diffuse * cos / np.sqrt(np.maximum(squares, 1e-30))
    return albedo * gain[..., None]


def _dot(a: Float[np.ndarray, "*n 3"], b: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
    """Dot products; three times as fast as einsum, whose loop over so short an axis is not vectorised."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def mip_levels(texture: UInt8[np.ndarray, "H W 3"]) -> tuple[UInt8[np.ndarray, "_ _ 3"], ...]:
    """Mipmap of a texture, finest level first: halved by a box filter until its shorter side is below 8 pixels."""
    from PIL import Image

    levels = [texture]
    while min(levels[-1].shape[:2]) >= 8:
        levels.append(np.asarray(Image.fromarray(levels[-1]).reduce(2)))
    return tuple(levels)


@dataclass(frozen=True, eq=False)
class Mipmap:
    """The levels of a mipmap in one array, finest first, so that samples of all levels are read together.

    ``texels``: rows of all levels, one level after the other. ``starts``: where each level begins.
    """

    texels: UInt8[np.ndarray, "t 3"]
    starts: Int[np.ndarray, " l"]
    heights: Int[np.ndarray, " l"]
    widths: Int[np.ndarray, " l"]

    @classmethod
    def of(cls, levels: Sequence[UInt8[np.ndarray, "_ _ 3"]]) -> Mipmap:
        """From the image of each level."""
        heights, widths = np.array([level.shape[:2] for level in levels]).T
        ends = np.cumsum(heights * widths)
        return cls(np.concatenate([level.reshape(-1, 3) for level in levels]), ends - heights * widths, heights, widths)


def texel_density(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    uv: Float[np.ndarray, "v 2"],
    size_hw: tuple[int, int],
) -> Float[np.ndarray, " f"]:
    """Texels per mm on each face, 0 for a degenerate face. ``size_hw``: size of the texture."""
    a, b, c = (uv[faces[:, k]] * (size_hw[1], size_hw[0]) for k in range(3))
    texels = np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    area = np.linalg.norm(face_normals(vertices, faces), axis=-1)
    return np.sqrt(np.where(area > 0, texels / np.maximum(area, 1e-30), 0.0))


def texture_colour(
    mipmap: Mipmap, uv: Float[np.ndarray, "n 2"], texels: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """Colours (0..255) at ``uv``, bilinear within one mip level. ``texels``: width of each sample in texels.

    The image repeats beyond its borders, and v = 0 is the lower edge of the last row.
    """
    # the nearest level is round(log2 x), which is the exponent of sqrt(2) x minus 1
    level = np.clip(np.frexp(np.maximum(texels, 1.0) * 2**0.5)[1] - 1, 0, len(mipmap.starts) - 1)
    h, w, start = mipmap.heights.take(level), mipmap.widths.take(level), mipmap.starts.take(level)
    x, y = uv[:, 0] * w.astype(uv.dtype) - 0.5, (1 - uv[:, 1]) * h.astype(uv.dtype) - 0.5
    x0, y0 = np.floor(x), np.floor(y)
    fx, fy = ((a - b).astype(np.float32, copy=False)[:, None] for a, b in ((x, x0), (y, y0)))
    left, right = _wrap(x0, w)
    rest = 1 - fx
    upper, lower = (
        mipmap.texels.take(row + left, axis=0) * rest + mipmap.texels.take(row + right, axis=0) * fx
        for row in (start + row * w for row in _wrap(y0, h))
    )
    upper *= 1 - fy
    lower *= fy
    return np.add(upper, lower, out=upper)


def _wrap(
    low: Float[np.ndarray, " n"], size: Int[np.ndarray, " n"]
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Indices ``low`` and ``low + 1``, both modulo ``size``."""
    first = low.astype(np.int64)
    after = first + 1
    beyond = np.flatnonzero((first < 0) | (after >= size))  # few: a modulo of all takes longer than the rest
    first[beyond] %= size[beyond]
    after[beyond] %= size[beyond]
    return first, after
