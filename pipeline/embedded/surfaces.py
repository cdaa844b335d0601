"""Views of an object -> the same views with another surface: random paint and relief as functions of object points.

A shard stores each object with a single surface. With a new one for every batch, surfaces never repeat, and they can be
sharper than vertex colours: labels, stripes, grooves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int64

from pipeline.embedded.pictures import View
from pipeline.synthetic.parts import Rng, random_direction

Points = Float[np.ndarray, "m 3"]
Values = Float[np.ndarray, " m"]
_WAVES = 5


def imitate_scan(clusters: list[list[View]], rng: Rng) -> list[list[View]]:
    """All views of one object as an imperfect mesh shows them: recoloured, with baked-in light, blurred, or untextured.

    Real meshes come from scanners or CAD, and differ from photographs in colour, sharpness and relief.
    """
    bare = rng.uniform(70, 220) if rng.uniform() < 0.15 else None
    toward, strength = random_direction(rng), rng.choice([0.0, rng.uniform(0.2, 0.8)])
    stains, depth = _random_waves(rng, fastest=rng.uniform(2, 25)), rng.choice([0.0, rng.uniform(0.05, 0.25)])
    saturation, gain, gamma = rng.uniform(0.3, 1.4), rng.uniform(0.7, 1.3, 3), np.exp(rng.uniform(-0.4, 0.4))
    blur, smooth = (rng.choice([0.0, rng.uniform(0.5, 2.5)]) for _ in range(2))

    def change(view: View) -> View:
        mask = view.mask
        y, x = np.nonzero(mask)
        normal = _blur_inside(view.normal, mask, smooth)
        normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
        if bare is not None:
            return replace(view, albedo=np.where(mask[..., None], np.uint8(bare), view.albedo), normal=normal)
        colour = _blur_inside(view.albedo.astype(np.float32), mask, blur)[y, x] / 255
        grey = colour.mean(-1, keepdims=True)
        light = 1 - strength + strength * np.maximum(view.normal[y, x] @ (view.T[:3, :3] @ toward), 0)
        light = light * (1 + depth * _sum_waves(stains, _points(view, y, x)))
        colour = np.clip(grey + saturation * (colour - grey), 0, 1) ** gamma * gain * light[:, None]
        albedo = view.albedo.copy()
        albedo[y, x] = np.clip(255 * colour, 0, 255)
        return replace(view, albedo=albedo, normal=normal)

    return [[change(view) for view in views] for views in clusters]


def _blur_inside(
    values: Float32[np.ndarray, "S S 3"], mask: Bool[np.ndarray, "S S"], sigma: float
) -> Float32[np.ndarray, "S S 3"]:
    """Gaussian blur that averages only pixels inside the mask."""
    if not sigma:
        return values
    inside = mask.astype(np.float32)
    weight = np.maximum(cv2.GaussianBlur(inside, (0, 0), sigma), 1e-3)
    return np.asarray(cv2.GaussianBlur(values * inside[..., None], (0, 0), sigma)) / weight[..., None]


def repaint(clusters: list[list[View]], rng: Rng) -> list[list[View]]:
    """All views of one object with one new surface; some keep their paint or their relief."""
    coats = [_coat(rng) for _ in range(int(rng.choice([0, 1, 2, 4], p=[0.35, 0.25, 0.25, 0.15])))]
    relief = _relief(rng) if rng.uniform() < 0.5 else None
    return [[_repaint_view(view, coats, relief) for view in views] for views in clusters]


Coat = Callable[[Points], tuple[Bool[np.ndarray, " m"], Float[np.ndarray, " 3"]]]


def _repaint_view(view: View, coats: list[Coat], relief: Callable[[Points], Points] | None) -> View:
    mask = view.mask
    y, x = np.nonzero(mask)
    points = _points(view, y, x)
    albedo, normal = view.albedo.copy(), view.normal
    for coat in coats:
        covered, colour = coat(points)
        albedo[y[covered], x[covered]] = colour
    if relief is not None:
        normal = normal.copy()
        original = normal[y, x]
        slope = (relief(points) @ view.T[:3, :3].T).astype(np.float32)
        tilted = original - slope + (slope * original).sum(-1, keepdims=True) * original
        normal[y, x] = tilted / np.maximum(np.linalg.norm(tilted, axis=-1, keepdims=True), 1e-6)
    return replace(view, albedo=albedo, normal=normal)


def _points(view: View, y: Int64[np.ndarray, " m"], x: Int64[np.ndarray, " m"]) -> Points:
    """Object points that pixels show."""
    T, K = view.T.astype(np.float64), view.K.astype(np.float64)
    z = view.depth[y, x] + T[2, 3]
    in_camera = np.stack([(x - K[0, 2]) / K[0, 0] * z, (y - K[1, 2]) / K[1, 1] * z, z], axis=-1)
    return (in_camera - T[:3, 3]) @ T[:3, :3]


def _coat(rng: Rng) -> Coat:
    """Which points get a colour, and which colour: blotches, stripes, a label or a patch."""
    kind, colour = rng.integers(4), rng.uniform(0, 255) + rng.normal(0, 50, 3) * rng.choice([0, 1])
    colour = np.clip(colour, 5, 250)
    axis, at = random_direction(rng), rng.uniform(-0.6, 0.6)
    centre, size = random_direction(rng) * rng.uniform(0.2, 0.9), rng.uniform(0.1, 0.5)
    waves, limit = _random_waves(rng, fastest=rng.uniform(5, 20)), rng.uniform(-0.5, 1.0)
    period, share = rng.uniform(0.06, 0.6), rng.uniform(0.15, 0.6)

    def cover(points: Points) -> tuple[Bool[np.ndarray, " m"], Float[np.ndarray, " 3"]]:
        near = np.linalg.norm(points - centre, axis=-1) < size
        if kind == 0:
            return _sum_waves(waves, points) > limit, colour
        if kind == 1:
            return (points @ axis - at) % period < share * period, colour
        if kind == 2:  # print on a label: blotches inside a patch
            return near & (_sum_waves(waves, points) > limit - 0.5), colour
        return near | (np.abs(points @ axis - at) < 0.15 * size), colour

    return cover


def _relief(rng: Rng) -> Callable[[Points], Points]:
    """Gradient of a random height over the surface: bumps, or equidistant grooves."""
    direction, phase, weight = _random_waves(rng, fastest=rng.uniform(6, 40))
    height = rng.uniform(0.05, 0.35)
    if rng.uniform() < 0.3:
        direction, phase, weight = direction[:1], phase[:1], np.ones(1)

    def gradient(points: Points) -> Points:
        return height * (np.cos(points @ direction.T + phase) * weight) @ direction / np.linalg.norm(direction[0])

    return gradient


Waves = tuple[Float[np.ndarray, "w 3"], Float[np.ndarray, " w"], Float[np.ndarray, " w"]]


def _random_waves(rng: Rng, *, fastest: float) -> Waves:
    """Wave vectors (radians per object radius), phases, weights."""
    direction = np.stack([random_direction(rng) for _ in range(_WAVES)]) * rng.uniform(0.3, 1, (_WAVES, 1)) * fastest
    return direction, rng.uniform(0, 2 * np.pi, _WAVES), rng.dirichlet(np.ones(_WAVES))


def _sum_waves(waves: Waves, points: Points) -> Values:
    direction, phase, weight = waves
    return np.sin(points @ direction.T + phase) @ weight / np.linalg.norm(weight)
