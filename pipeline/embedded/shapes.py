"""seed -> an object to train on: assemblies of revolved, extruded, bent, bumpy or box-like parts.

The variety is larger than in ``synthetic.objects``, which the benchmark uses: some objects are symmetric, hollow or
thin, and many have a single colour.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.functional.viewpoints import icosphere_mesh
from pipeline.items.objects import Mesh
from pipeline.synthetic.parts import (
    Rng,
    Shape,
    random_direction,
    random_rotation,
    revolve,
    smooth_noise,
    superquadric,
    tube,
)

Points = Float[np.ndarray, "v 3"]


def make_training_object(seed: int) -> Mesh:
    """A mesh with vertex colours; the origin is the centre of its bounding box, its farthest vertex at distance 1."""
    rng = np.random.default_rng([seed, 0x7EA1])
    parts = _assembly(rng)
    vertices = np.concatenate([points for points, _ in parts])
    part = np.repeat(np.arange(len(parts)), [len(points) for points, _ in parts])
    offsets = np.cumsum([0] + [len(points) for points, _ in parts[:-1]])
    faces = np.concatenate([part_faces + offset for (_, part_faces), offset in zip(parts, offsets, strict=True)])
    vertices = _bend(vertices, rng) @ random_rotation(rng).T
    vertices = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    vertices /= np.linalg.norm(vertices, axis=-1).max()
    return Mesh(vertices, faces, colours=_paint(vertices, part, rng), digest=f"training object {seed}")


def _assembly(rng: Rng) -> list[Shape]:
    """Parts of one family, or of two families that intersect."""
    parts = _FAMILIES[rng.integers(len(_FAMILIES))](rng)
    if rng.uniform() < 0.35:
        size, turn = rng.uniform(0.3, 0.9), random_rotation(rng)
        shift = 0.9 * random_direction(rng)
        other = _FAMILIES[rng.integers(len(_FAMILIES))](rng)
        parts = parts + [(size * points @ turn.T + shift, faces) for points, faces in other]
    return parts


def _blob(rng: Rng) -> list[Shape]:
    """A sphere displaced by smooth noise."""
    points, faces = icosphere_mesh(3)
    radius = 1 + rng.uniform(0.1, 0.4) * smooth_noise(points, rng, scale=rng.uniform(0.6, 1.1))
    radius = radius + rng.uniform(0, 0.12) * smooth_noise(points, rng, scale=0.3)
    return [(points * np.maximum(radius, 0.3)[:, None] * rng.uniform(0.45, 1.1, 3), faces)]


def _figure(rng: Rng) -> list[Shape]:
    """A body with smaller rounded parts, some of them in mirrored pairs: animals, toys."""
    size = rng.uniform(0.5, 1.1, 3)
    parts = [_lump(rng, size)]
    for _ in range(int(rng.integers(2, 6))):
        points, faces = _lump(rng, rng.uniform(0.12, 0.6, 3))
        placed = points @ random_rotation(rng).T + size * random_direction(rng) * rng.uniform(0.7, 1.2)
        parts.append((placed, faces))
        if rng.uniform() < 0.5:
            parts.append((placed * [-1, 1, 1], faces[:, ::-1]))
    return parts


def _lump(rng: Rng, size: Float[np.ndarray, " 3"]) -> Shape:
    points, faces = superquadric(rng, size, roundness=float(rng.uniform(0.6, 1.1)))
    bumps = 1 + rng.uniform(0, 0.12) * smooth_noise(points / size, rng, scale=0.5)
    return points * bumps[:, None], faces


def _revolved(rng: Rng) -> list[Shape]:
    """A surface of revolution, sometimes hollow, sometimes with handles or spouts: bottles, cans, jugs."""
    rows = 60
    height = np.linspace(-1, 1, rows) * rng.uniform(0.4, 1.2)
    along = np.stack([np.linspace(-1, 1, rows), np.zeros(rows), np.zeros(rows)], -1)
    profile = 0.6 + rng.uniform(0.05, 0.25) * smooth_noise(along, rng, scale=rng.uniform(0.3, 0.9))
    if rng.uniform() < 0.4:  # steps, as of cans and bottles
        profile = np.where(np.linspace(0, 1, rows) > rng.uniform(0.5, 0.9), profile * rng.uniform(0.3, 0.8), profile)
    profile = np.maximum(profile, 0.12)
    if rng.uniform() < 0.4:  # hollow: the profile goes up outside and down inside
        height = np.concatenate([height, height[::-1][:-4]])
        profile = np.concatenate([profile, np.maximum(profile[::-1][:-4] - 0.08, 0.05)])
    segments = int(rng.choice([6, 8, 48, 48]))
    parts = [revolve(profile[:, None] * np.ones(segments), height)]
    for _ in range(int(rng.choice([0, 0, 1, 1, 2]))):
        parts.append(_handle(rng, float(profile[:rows].mean()), float(np.ptp(height))))
    return parts


def _handle(rng: Rng, reach: float, span: float) -> Shape:
    bow = np.linspace(0.1, np.pi * rng.uniform(0.45, 0.97), 30)
    x = 0.8 * reach + rng.uniform(0.3, 0.8) * np.sin(bow)
    z = rng.uniform(-0.2, 0.2) * span + rng.uniform(0.2, 0.4) * span * np.cos(bow)
    points, faces = tube(np.stack([x, np.zeros(30), z], -1), rng.uniform(0.06, 0.16))
    angle = rng.uniform(0, 2 * np.pi)
    c, s = np.cos(angle), np.sin(angle)
    return points @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T, faces


def _extrusion(rng: Rng) -> list[Shape]:
    """A lobed or polygonal outline, extruded, tapered and sometimes twisted, with up to two bosses."""
    segments, rows = 96, 24
    angle = 2 * np.pi * np.arange(segments) / segments
    outline = 0.7 + sum(rng.normal(0, 0.22 / k) * np.cos(k * angle + rng.uniform(0, 2 * np.pi)) for k in range(1, 7))
    if rng.uniform() < 0.5:  # facets
        corners = int(rng.integers(3, 9))
        outline = outline / np.cos((angle % (2 * np.pi / corners)) - np.pi / corners)
    height = np.linspace(-1, 1, rows) * rng.uniform(0.1, 0.9)
    taper = np.linspace(1, rng.uniform(0.5, 1.1), rows)
    points, faces = revolve(np.clip(outline, 0.15, 1.4) * taper[:, None], height)
    turn = rng.choice([0, 0, rng.uniform(-1.5, 1.5)]) * points[:, 2]
    c, s = np.cos(turn), np.sin(turn)
    points = np.stack([c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1], points[:, 2]], -1)
    parts = [(points, faces)]
    for _ in range(int(rng.integers(0, 3))):
        boss, boss_faces = revolve(
            np.full((8, 24), rng.uniform(0.08, 0.35)), np.linspace(0, rng.uniform(0.2, 0.8), 8), lid=3
        )
        parts.append((boss + np.array([*rng.uniform(-0.4, 0.4, 2), height[-1] - 0.05]), boss_faces))
    return parts


def _machine(rng: Rng) -> list[Shape]:
    """Blocks and cylinders attached to a block: tools, housings, brackets."""
    size = rng.uniform(0.2, 1.0, 3)
    parts = [superquadric(rng, size, roundness=float(rng.uniform(0.1, 0.4)))]
    for _ in range(int(rng.integers(1, 6))):
        at = size * rng.uniform(-0.8, 0.8, 3)
        axis = int(rng.integers(3))
        at[axis] = size[axis] * rng.choice([-1, 1])
        if rng.uniform() < 0.5:
            points, faces = superquadric(rng, rng.uniform(0.06, 0.6, 3), roundness=float(rng.uniform(0.1, 0.3)))
        else:
            length = rng.uniform(0.1, 0.8)
            points, faces = revolve(np.full((12, 28), rng.uniform(0.06, 0.4)), np.linspace(-length, length, 12), lid=3)
            points = np.roll(points, int(rng.integers(3)), axis=-1)
        parts.append((points + at, faces))
    return parts


def _bar(rng: Rng) -> list[Shape]:
    """A bar with a lobed cross-section that twists, bends and thickens: bananas, handles, shells."""
    rows, segments = 60, 40
    along = np.linspace(0, 1, rows)
    angle = 2 * np.pi * np.arange(segments) / segments
    lobes = 1 + rng.uniform(0, 0.35) * np.cos(int(rng.integers(2, 5)) * angle) + 0.15 * np.cos(angle)
    thick = rng.uniform(0.1, 0.35) + rng.uniform(-0.1, 0.3) * along + 0.08 * np.sin(rng.uniform(2, 9) * along)
    points, faces = revolve(np.maximum(thick, 0.06)[:, None] * lobes, 2 * along - 1)
    turn = rng.uniform(0, 2.5) * points[:, 2]
    x = np.cos(turn) * points[:, 0] - np.sin(turn) * points[:, 1]
    y = np.sin(turn) * points[:, 0] + np.cos(turn) * points[:, 1]
    return [(np.stack([x + rng.uniform(0, 0.9) * points[:, 2] ** 2, y, points[:, 2]], axis=-1), faces)]


def _relief(rng: Rng) -> list[Shape]:
    """A slab with rows of bumps, dents or steps on top: boxes, trays, keyboards."""
    points, faces = superquadric(rng, np.array([1.0, rng.uniform(0.4, 1.0), 1.0]), roundness=0.12, level=4)
    kx, ky = rng.uniform(2, 12, 2)
    bumps = np.sin(kx * points[:, 0] + rng.uniform(0, 6)) * np.sin(ky * points[:, 1] + rng.uniform(0, 6))
    if rng.uniform() < 0.4:
        bumps = np.sign(bumps)
    top = rng.uniform(0.1, 0.5) + rng.uniform(0.05, 0.25) * bumps + rng.uniform(-0.3, 0.3) * points[:, 0]
    z = np.where(points[:, 2] > 0, points[:, 2] * np.maximum(top, 0.03), points[:, 2] * rng.uniform(0.05, 0.4))
    return [(np.stack([points[:, 0], points[:, 1], z], -1), faces)]


def _pipes(rng: Rng) -> list[Shape]:
    """Intersecting bent rods: hooks, frames, taps."""
    parts = []
    for _ in range(int(rng.integers(1, 4))):
        t = np.linspace(0, 1, 40)
        x, z = (np.cumsum(smooth_noise(np.stack([t, 0 * t, 0 * t], -1), rng, scale=0.25)) / 20 for _ in range(2))
        points, faces = tube(np.stack([x, 0 * t, z + 2 * t - 1], -1), rng.uniform(0.06, 0.22))
        parts.append((points @ random_rotation(rng).T * rng.uniform(0.5, 1), faces))
    return parts


_FAMILIES: tuple[Callable[[Rng], list[Shape]], ...] = (
    _blob, _figure, _figure, _revolved, _revolved, _extrusion, _machine, _machine, _bar, _relief, _pipes
)  # fmt: skip


def _bend(points: Points, rng: Rng) -> Points:
    """Stretch along the axes; half of the objects are also bent and tapered along the first."""
    points = points * rng.uniform(0.6, 1.4, 3)
    if rng.uniform() < 0.5:
        return points
    x = points[:, :1] / np.abs(points).max()
    shear = np.concatenate([np.zeros_like(x), rng.normal(0, 0.3, 2) * x**2], axis=1)
    return points * (1 + rng.uniform(-0.4, 0.4) * x) + shear * np.abs(points).max()


def _paint(points: Points, part: Int[np.ndarray, " v"], rng: Rng) -> UInt8[np.ndarray, "v 3"]:
    """One colour, one per part, regions or a pattern; with dirt and sometimes baked-in light, as in scans."""
    palette = np.array([_random_colour(rng) for _ in range(8)])
    style = rng.choice(["plain", "parts", "regions", "pattern"], p=[0.4, 0.25, 0.2, 0.15])
    index = np.zeros(len(points), dtype=int)
    if style == "parts":
        index = part % len(palette)
    elif style == "regions":
        seeds = points[rng.integers(len(points), size=int(rng.integers(2, 8)))]
        index = ((points[:, None] - seeds) ** 2).sum(-1).argmin(axis=1) % 4
    elif style == "pattern":
        index = (smooth_noise(points, rng, scale=rng.uniform(0.12, 0.5)) > rng.uniform(-0.5, 0.8)).astype(int)
        index += 2 * (smooth_noise(points, rng, scale=rng.uniform(0.3, 0.8)) > 0.8)
    dirt = (
        1
        + rng.uniform(0, 0.15) * smooth_noise(points, rng, scale=0.35)
        + rng.uniform(0, 0.08) * smooth_noise(points, rng, scale=0.1)
    )
    baked = 1 + rng.choice([0.0, rng.uniform(0, 0.35)]) * points @ random_direction(rng)
    return np.clip(palette[index] * (dirt * baked)[:, None], 0, 255).astype(np.uint8)


def _random_colour(rng: Rng) -> Float[np.ndarray, " 3"]:
    """A random grey, dull or saturated colour (0..255)."""
    hue, value = rng.uniform(), rng.uniform(0.15, 1.0)
    saturation = rng.choice([0.0, rng.uniform(0, 0.4), rng.uniform(0.4, 1.0)])
    pure = np.clip(np.abs((hue * 6 + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1, 0, 1)
    return 255 * value * (1 - saturation + saturation * pure)
