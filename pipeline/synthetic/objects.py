"""seed -> a textured object without symmetries."""

from __future__ import annotations

from collections.abc import Callable
from hashlib import sha256

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.functional.viewpoints import icosphere_mesh
from pipeline.io.meshes import diameter_mm
from pipeline.items.objects import Mesh
from pipeline.synthetic.parts import (
    Rng,
    Shape,
    merge,
    polygon_radius,
    random_direction,
    random_rotation,
    revolve,
    smooth_noise,
    superquadric,
    tube,
)

FAMILIES = ("pebble", "superquadrics", "vessel", "prism", "machined", "twist")
DIAMETERS_MM = (60.0, 250.0)


def make_object(seed: int) -> Mesh:
    """A closed mesh (mm, centred) with a solid texture as vertex colours; ``seed`` modulo 6 selects the family.

    Diameter 60 to 250 mm, 10,000 to 21,000 faces. Neither shape nor colours are symmetric.
    """
    rng = np.random.default_rng([seed, 0x0B1EC7])
    vertices, faces = _BUILDERS[FAMILIES[seed % len(FAMILIES)]](rng)
    vertices = vertices @ random_rotation(rng).T
    vertices = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    vertices *= rng.uniform(DIAMETERS_MM[0] + 5, DIAMETERS_MM[1] - 5) / diameter_mm(Mesh(vertices, faces))
    # rounded to float32, the precision of the ply it may be written to
    vertices = vertices.astype(np.float32).astype(np.float64)
    colours = _solid_texture(vertices, rng)
    content = vertices.tobytes() + faces.astype("<i8").tobytes() + colours.tobytes()
    return Mesh(vertices, faces, colours=colours, digest=sha256(content).hexdigest())


def _pebble(rng: Rng) -> Shape:
    """A sphere displaced by smooth noise, stretched along its axes."""
    points, faces = icosphere_mesh(4)
    radius = 1 + 0.35 * smooth_noise(points, rng, scale=0.9) + 0.1 * smooth_noise(points, rng, scale=0.35)
    return points * np.maximum(radius, 0.3)[:, None] * rng.uniform(0.6, 1.2, 3), faces


def _superquadrics(rng: Rng) -> Shape:
    """Three or four superquadrics (Barr, 1981) of decreasing size, attached to the first."""
    size = rng.uniform(0.6, 1.2, 3)
    parts = [superquadric(rng, size)]
    for k in range(int(rng.integers(2, 4))):
        part, faces = superquadric(rng, rng.uniform(0.25, 0.6, 3) * (1 - 0.15 * k))
        parts.append((part + size * random_direction(rng), faces))
    return merge(parts)


def _vessel(rng: Rng) -> Shape:
    """A surface of revolution with a dent, and a handle on one side."""
    rows, segments = 70, 64
    height = np.linspace(-1, 1, rows)
    profile = 0.55 + 0.2 * smooth_noise(np.stack([height, 0 * height, 0 * height], axis=-1), rng, scale=0.7)
    angle = 2 * np.pi * np.arange(segments) / segments
    away = np.abs((angle - rng.uniform(1, 5) + np.pi) % (2 * np.pi) - np.pi)
    dent = 0.3 * np.exp(-((height[:, None] - rng.uniform(-0.5, 0.5)) ** 2) / 0.08 - away**2 / 0.3)
    body = revolve(np.maximum(profile, 0.25)[:, None] * np.ones(segments) * (1 - dent), height)
    bow = np.linspace(0.15, np.pi - 0.15, 40)
    reach, span = rng.uniform(0.5, 0.8), rng.uniform(0.35, 0.55)
    middle = rng.uniform(-0.35, 0.25)
    path = np.stack([0.4 + reach * np.sin(bow), np.zeros(40), middle + span * np.cos(bow)], axis=-1)
    return merge([body, tube(path, rng.uniform(0.07, 0.12))])


def _prism(rng: Rng) -> Shape:
    """An irregular polygon, extruded and tapered, with a boss on its top."""
    segments, corners = 120, int(rng.integers(4, 8))
    angle = 2 * np.pi * np.arange(segments) / segments
    at = np.sort((np.arange(corners) + rng.uniform(-0.3, 0.3, corners)) * 2 * np.pi / corners)
    reach = rng.uniform(0.55, 1.0, corners)
    corner = np.stack([reach * np.cos(at), reach * np.sin(at)], axis=-1)
    outline = polygon_radius(corner, angle)
    rows = 40
    height = np.linspace(-1, 1, rows) * rng.uniform(0.3, 0.6)
    body = revolve(outline[None] * np.linspace(1, rng.uniform(0.6, 0.9), rows)[:, None], height)
    boss, faces = revolve(np.full((14, 40), rng.uniform(0.15, 0.25)), np.linspace(0, rng.uniform(0.2, 0.4), 14), lid=4)
    return merge([body, (boss + np.array([*rng.uniform(-0.25, 0.25, 2), height[-1] - 0.05]), faces)])


def _machined(rng: Rng) -> Shape:
    """A block with a second block and two or three cylinders on different sides of it."""
    size = rng.uniform(0.4, 1.0, 3)
    other, other_faces = superquadric(rng, rng.uniform(0.3, 0.5, 3), roundness=0.2)
    parts = [superquadric(rng, size, roundness=0.2), (other + size * np.sign(random_direction(rng)) * 0.6, other_faces)]
    for axis in rng.permutation(3)[: int(rng.integers(2, 4))]:
        radius, length = rng.uniform(0.12, 0.25), rng.uniform(0.3, 0.7)
        pin, faces = revolve(np.full((24, 40), radius), np.linspace(0, length, 24), lid=3)
        pin = np.roll(pin + np.array([*rng.uniform(-0.2, 0.2, 2), size[axis] * 0.9]), axis + 1, axis=-1)
        parts.append((pin * np.where(np.arange(3) == axis, rng.choice([-1, 1]), 1), faces))
    return merge(parts)


def _twist(rng: Rng) -> Shape:
    """A bar with a lobed cross-section that twists, bends and thickens along its length."""
    rows, segments = 90, 60
    along = np.linspace(0, 1, rows)
    angle = 2 * np.pi * np.arange(segments) / segments
    lobes = 1 + rng.uniform(0.15, 0.35) * np.cos(int(rng.integers(2, 5)) * angle) + 0.15 * np.cos(angle)
    vertices, faces = revolve((0.25 + 0.3 * along**2)[:, None] * lobes, 2 * along - 1)
    turn = rng.uniform(1.0, 3.0) * vertices[:, 2]
    x = np.cos(turn) * vertices[:, 0] - np.sin(turn) * vertices[:, 1]
    y = np.sin(turn) * vertices[:, 0] + np.cos(turn) * vertices[:, 1]
    return np.stack([x + rng.uniform(0.3, 0.7) * vertices[:, 2] ** 2, y, vertices[:, 2]], axis=-1), faces


_BUILDERS: dict[str, Callable[[Rng], Shape]] = dict(
    zip(FAMILIES, (_pebble, _superquadrics, _vessel, _prism, _machined, _twist), strict=True)
)


def _solid_texture(vertices: Float[np.ndarray, "v 3"], rng: Rng) -> UInt8[np.ndarray, "v 3"]:
    """Patterned regions of space in four or five colours under uneven dirt; lengths scale with the object's size."""
    size = float(np.ptp(vertices, axis=0).max())
    points = vertices / size
    palette = _palette(rng)
    region = _cells(points, rng, count=int(rng.integers(6, 10)))
    colours = palette[region % len(palette)]
    for _ in range(int(rng.integers(2, 4))):
        where = _pattern(points, rng) & np.isin(region, rng.permutation(region.max() + 1)[: region.max() // 2 + 1])
        colours = np.where(where[:, None], palette[rng.integers(len(palette))], colours)
    dirt = 1 + 0.1 * smooth_noise(points, rng, scale=0.25) + 0.05 * smooth_noise(points, rng, scale=0.06)
    return np.clip(colours * dirt[:, None], 0, 255).astype(np.uint8)


def _palette(rng: Rng) -> Float[np.ndarray, "k 3"]:
    """Four or five colours (0..255) with distinct hues and lightness."""
    count = int(rng.integers(4, 6))
    hue = (rng.uniform() + np.arange(count) / count + rng.uniform(-0.06, 0.06, count))[:, None]
    saturation, value = rng.uniform(0.35, 0.95, (count, 1)), rng.permutation(np.linspace(0.25, 1.0, count))[:, None]
    pure = np.clip(np.abs((hue * 6 + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1, 0, 1)
    return 255 * value * (1 - saturation + saturation * pure)


def _cells(points: Float[np.ndarray, "n 3"], rng: Rng, *, count: int) -> Int[np.ndarray, " n"]:
    """Index of the nearest of ``count`` random seeds, with warped borders."""
    seeds = points[rng.integers(len(points), size=count)]
    warped = points + 0.05 * np.stack([smooth_noise(points, rng, scale=0.2) for _ in range(3)], axis=-1)
    return ((warped[:, None] - seeds) ** 2).sum(-1).argmin(axis=1)


def _pattern(points: Float[np.ndarray, "n 3"], rng: Rng) -> Bool[np.ndarray, " n"]:
    """Stripes, checks, spots or blotches."""
    kind, width = rng.integers(4), rng.uniform(0.07, 0.14)
    turned = points @ random_rotation(rng).T + rng.uniform(size=3)
    if kind == 0:
        return np.sin(np.pi * turned[:, 0] / width) > rng.uniform(-0.3, 0.5)
    if kind == 1:
        return np.floor(turned / width).sum(axis=-1) % 2 == 0
    if kind == 2:
        spots = points[rng.integers(len(points), size=40)]
        return ((points[:, None] - spots) ** 2).sum(-1).min(axis=1) < (0.5 * width) ** 2
    return smooth_noise(points, rng, scale=width) > 0.3
