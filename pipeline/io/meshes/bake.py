"""Transfer the colours of a surface to the texture of another one nearby, with a block of texels per face."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.functional.shading import Mipmap, face_normals, mip_levels, texel_density, texture_colour
from pipeline.functional.surface import SurfacePoints, face_areas, spread_points
from pipeline.items.objects import Mesh
from pipeline.parallel import worker_count

_SAMPLES = 2_000_000  # samples of the surface: 10 per pixel of a template of 256 px
_TEXELS = 500_000  # texels for the surface's area; blocks need about five times as many, small faces more
_WIDTH, _MAX_HEIGHT = 4096, 8192
_MIN_BLOCK, _MAX_BLOCK = 4, 1024
_FACING = 4.0  # distance, in sample spacings, that a unit of difference between normals adds
_FAR, _FAR_EVERY = 6.0, 64  # a point is far at this many spacings; every 64th sample is 8 spacings from the next
_CHUNK = 1 << 18


@dataclass(frozen=True)
class _Blocks:
    """Each face's block of texels: upper left corner (x, y), where the face's first corner is, and size."""

    corner: Int[np.ndarray, "f 2"]
    size: Int[np.ndarray, "f 2"]
    height: int


def bake_texture(source: Mesh, mesh: Mesh) -> Mesh:
    """``mesh`` with the colours of ``source``, each from the nearest point that faces the same way."""
    faces = _longest_side_first(mesh)
    faces = faces[_order_by_place(mesh.vertices, faces)]  # blocks blend into neighbours at coarse mipmap levels
    blocks = _lay_out(mesh.vertices, faces)
    texture = np.zeros((blocks.height, _WIDTH, 3), dtype=np.uint8)
    look_up = _Colours(source)
    normals = _unit(face_normals(mesh.vertices, faces))
    for size in np.unique(blocks.size, axis=0):
        chosen = np.flatnonzero((blocks.size == size).all(axis=1))
        step = max(1, _CHUNK // int(size.prod()))
        for row in range(0, len(chosen), step):
            part = chosen[row : row + step]
            x, y, weight = _block_texels(size)
            face = np.repeat(part, len(x))
            points = SurfacePoints(face, np.tile(weight, (len(part), 1))).interpolate(mesh.vertices, faces)
            where = np.repeat(blocks.corner[part], len(x), axis=0) + np.tile(np.stack([x, y], axis=-1), (len(part), 1))
            texture[where[:, 1], where[:, 0]] = look_up(points, normals[face])
    ends = np.stack([np.zeros_like(blocks.size), blocks.size * [1, 0] - [1, 0], blocks.size * [0, 1] - [0, 1]], axis=1)
    px = blocks.corner[:, None] + ends + 0.5
    uv = np.stack([px[..., 0] / _WIDTH, 1 - px[..., 1] / blocks.height], axis=-1).reshape(-1, 2)
    corners = np.arange(faces.size).reshape(-1, 3)
    return replace(mesh, vertices=mesh.vertices[faces.reshape(-1)], faces=corners, colours=None, uv=uv, texture=texture)


def _longest_side_first(mesh: Mesh) -> Int[np.ndarray, "f 3"]:
    """The faces, rotated so that the longest side is from the first to the second corner."""
    corners = mesh.vertices[mesh.faces]
    lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=-1)
    first = lengths.argmax(axis=1)[:, None]
    return np.take_along_axis(mesh.faces, (first + np.arange(3)) % 3, axis=1)


def _order_by_place(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, " f"]:
    """Order that keeps faces of similar direction and position together: by normal octant, then Morton code."""
    centres = vertices[faces].mean(axis=1)
    low, extent = centres.min(axis=0), np.ptp(centres, axis=0).max()
    cells = ((centres - low) / max(extent, 1e-30) * 1023).astype(np.int64)
    octant = (face_normals(vertices, faces) > 0) @ [1, 2, 4]
    bits = [((cells[:, axis] >> bit) & 1) << (3 * bit + axis) for bit in range(10) for axis in range(3)]
    return np.argsort((octant << 30) + np.sum(bits, axis=0), kind="stable")


def _lay_out(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> _Blocks:
    """Blocks packed in rows by size. Sides are powers of two, so that coarser mipmap levels keep blocks separate."""
    areas = face_areas(vertices, faces)
    width = np.linalg.norm(vertices[faces[:, 1]] - vertices[faces[:, 0]], axis=-1)
    sides = np.stack([width, 2 * areas / np.maximum(width, 1e-30)], axis=-1)
    texel = (areas.sum() / _TEXELS) ** 0.5
    while True:
        exponent = np.ceil(np.log2(np.clip(sides / texel, _MIN_BLOCK, _MAX_BLOCK))).astype(np.int64)
        corner, height = _place(1 << exponent)
        if height <= _MAX_HEIGHT or exponent.max() <= np.log2(_MIN_BLOCK):
            return _Blocks(corner, 1 << exponent, height)
        texel *= 1.25


def _place(size: Int[np.ndarray, "f 2"]) -> tuple[Int[np.ndarray, "f 2"], int]:
    """Upper left corners of the blocks, and their total height."""
    corner, top = np.zeros_like(size), 0
    for w, h in np.unique(size, axis=0)[::-1].tolist():
        chosen = np.flatnonzero((size == (w, h)).all(axis=1))
        row, column = np.divmod(np.arange(len(chosen)), _WIDTH // w)
        corner[chosen] = np.stack([column * w, top + row * h], axis=-1)
        top += (int(row[-1]) + 1) * h
    return corner, top


def _block_texels(
    size: Int[np.ndarray, " 2"],
) -> tuple[Int[np.ndarray, " t"], Int[np.ndarray, " t"], Float[np.ndarray, "t 3"]]:
    """x, y and barycentric weights of a block's texels, clamped to the nearest point beyond the longest side."""
    y, x = (axis.reshape(-1) for axis in np.indices((size[1], size[0])))
    u, v = x / (size[0] - 1), y / (size[1] - 1)
    beyond = np.maximum(u + v - 1, 0) / 2
    u, v = np.maximum(u - beyond, 0), np.maximum(v - beyond, 0)
    return x, y, np.stack([1 - u - v, u, v], axis=-1)


class _Colours:
    """Looks up the colours that a mesh shows near points."""

    def __init__(self, mesh: Mesh) -> None:
        from scipy.spatial import cKDTree

        area = face_areas(mesh.vertices, mesh.faces).sum()
        self._spacing = (area / _SAMPLES) ** 0.5
        samples = spread_points(mesh.vertices, mesh.faces, _SAMPLES)
        self._colours = _sample_colours(mesh, samples, self._spacing)
        normals = _unit(face_normals(mesh.vertices, mesh.faces[samples.face]))
        points = samples.interpolate(mesh.vertices, mesh.faces)
        places = self._join(points, normals)
        self._tree = cKDTree(places, balanced_tree=False)
        self._every = _FAR_EVERY if len(places) > _FAR_EVERY else 1
        self._far_tree = cKDTree(places[:: self._every], balanced_tree=False)

    def __call__(self, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n 3"]:
        """The colour of the nearest sample, where a different normal adds to the distance.

        Points far from all samples are looked up among every 64th: the exact search would visit most samples, because
        all of them are about equally far away.
        """
        places, threads = self._join(points, normals), worker_count()
        distance, index = self._tree.query(places, distance_upper_bound=_FAR * self._spacing, workers=threads)
        far = np.isinf(distance)
        if far.any():
            index[far] = self._every * self._far_tree.query(places[far], workers=threads)[1]
        return self._colours[index]

    def _join(self, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 6"]:
        return np.concatenate([points, _FACING * self._spacing * normals], axis=-1)


def _sample_colours(mesh: Mesh, samples: SurfacePoints, spacing_mm: float) -> UInt8[np.ndarray, "n 3"]:
    if mesh.texture is None or mesh.uv is None:
        assert mesh.colours is not None
        return np.rint(samples.interpolate(mesh.colours.astype(float), mesh.faces)).astype(np.uint8)
    density = texel_density(mesh.vertices, mesh.faces, mesh.uv, mesh.texture.shape[:2])[samples.face]
    uv = samples.interpolate(mesh.uv, mesh.faces)
    return np.rint(texture_colour(Mipmap.of(mip_levels(mesh.texture)), uv, density * spacing_mm)).astype(np.uint8)


def _unit(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)
