"""seed -> objects placed before a camera, some hidden in part by others as far as asked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32

from pipeline.functional.rigid import rigid
from pipeline.items.objects import Mesh
from pipeline.stages.render.cameras import bounding_sphere
from pipeline.stages.render.raycast import render_depth
from pipeline.synthetic.objects import random_rotation

OCCLUDED = (0.4, 0.9)  # visible fraction of an instance that is meant to be occluded
_FREE = 0.97  # and at least of one that is not
_TRIES = 60

Rng = np.random.Generator


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera of one image."""

    K: Float[np.ndarray, "3 3"]
    size_hw: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Thing:
    """An object placed in an image; ``obj_id`` 0 for a distractor. ``limits``: the visible fraction it is to have."""

    obj_id: int
    mesh: Mesh
    T_cam_obj: Float[np.ndarray, "4 4"]
    depth_mm: Float32[np.ndarray, "H W"]
    limits: tuple[float, float]


def _place(
    mesh: Mesh,
    centre_cam: Float[np.ndarray, " 3"],
    camera: Camera,
    rng: Rng,
    *,
    obj_id: int = 0,
    limits: tuple[float, float] = (0.0, 1.0),
) -> Thing:
    """The mesh with its centre at a point of the camera frame, turned at random; t is rounded as it will be written."""
    R = random_rotation(rng)
    T = rigid(R, np.round(centre_cam - R @ bounding_sphere(mesh)[0], 4))
    return Thing(obj_id, mesh, T, render_depth(mesh, camera.K, T[None], camera.size_hw)[0], limits)


def nominal_K(size_hw: tuple[int, int]) -> Float[np.ndarray, "3 3"]:
    """The camera matrix that images vary about."""
    h, w = size_hw
    return np.array([[0.92 * w, 0.0, (w - 1) / 2], [0.0, 0.92 * w, (h - 1) / 2], [0.0, 0.0, 1.0]])


def random_camera(size_hw: tuple[int, int], rng: Rng) -> Camera:
    """The nominal camera with another focal length, slightly unequal pixels and a shifted principal point."""
    K = nominal_K(size_hw)
    K[[0, 1], [0, 1]] *= rng.uniform(0.93, 1.07) * np.array([1.0, rng.uniform(0.995, 1.005)])
    K[:2, 2] += rng.uniform(-0.03, 0.03, 2) * size_hw[1]
    return Camera(np.round(K, 5), size_hw)


def arrange(
    chosen: Sequence[tuple[int, Mesh]],
    hidden: Bool[np.ndarray, " n"],
    distractors: Sequence[Mesh],
    camera: Camera,
    rng: Rng,
) -> list[Thing]:
    """The objects side by side, then a distractor before each that is to be hidden, then distractors behind."""
    things: list[Thing] = []
    for (obj_id, mesh), hide in zip(chosen, hidden, strict=True):
        things.append(_beside(obj_id, mesh, OCCLUDED if hide else (_FREE, 1.0), things, camera, rng))
    waiting = [thing for thing, hide in zip(things, hidden, strict=True) if hide]
    while waiting:
        things = _hide(waiting.pop(), things, waiting, distractors, camera, rng)
    for mesh in distractors[:2]:
        centre = _point(camera, rng, rng.uniform(1050, 1150), bounding_sphere(mesh)[1])
        things.append(_place(mesh, centre, camera, rng))
    return things


def _beside(
    obj_id: int, mesh: Mesh, limits: tuple[float, float], others: Sequence[Thing], camera: Camera, rng: Rng
) -> Thing:
    """A place in the image, far enough from the others if there is one, else the best of those tried."""
    _, radius = bounding_sphere(mesh)
    best, best_overlap = None, np.inf
    for _ in range(_TRIES):
        # large objects stand back: at most about a quarter of the image's width
        depth = rng.uniform(max(500.0, min(6.5 * radius, 900.0)), 1000.0)
        thing = _place(mesh, _point(camera, rng, depth, radius), camera, rng, obj_id=obj_id, limits=limits)
        silhouette = thing.depth_mm > 0
        overlap = sum(float((silhouette & (other.depth_mm > 0)).sum()) for other in others)
        if overlap < best_overlap:
            best, best_overlap = thing, overlap
        if overlap == 0:
            break
    assert best is not None
    return best


def _hide(
    thing: Thing,
    things: list[Thing],
    waiting: Sequence[Thing],
    distractors: Sequence[Mesh],
    camera: Camera,
    rng: Rng,
) -> list[Thing]:
    """The things with a distractor before ``thing``, such that all but those ``waiting`` are as visible as wanted.

    The best of those tried where none satisfies all.
    """
    at = thing.T_cam_obj[:3, :3] @ bounding_sphere(thing.mesh)[0] + thing.T_cam_obj[:3, 3]
    best, least = things, np.inf
    for _ in range(_TRIES):
        mesh = distractors[int(rng.integers(len(distractors)))]
        reach = bounding_sphere(thing.mesh)[1] + bounding_sphere(mesh)[1]
        angle, aside = rng.uniform(0, 2 * np.pi), rng.uniform(0.2, 0.9) * reach
        before = at * (1 - (reach + 10) / at[2]) + aside * np.array([np.cos(angle), np.sin(angle), 0])
        candidate = [*things, _place(mesh, before, camera, rng)]
        excess = sum(
            _excess(visible, other, waits=any(other is w for w in waiting))
            for visible, other in zip(_fractions(candidate), candidate, strict=True)
        )
        if excess < least:
            best, least = candidate, excess
        if excess == 0:
            break
    return best


def _excess(visible: float, thing: Thing, *, waits: bool) -> float:
    """How far a visible fraction lies outside the thing's limits; to be seen whole is no fault of one that waits."""
    low, high = thing.limits
    return max(low - visible, 0.0) + (0.0 if waits else max(visible - high, 0.0))


def _fractions(things: Sequence[Thing]) -> list[float]:
    return [float(visible.sum() / max((thing.depth_mm > 0).sum(), 1)) for thing, visible in visible_parts(things)]


def visible_parts(things: Sequence[Thing]) -> list[tuple[Thing, Bool[np.ndarray, "H W"]]]:
    """Each thing with the pixels in which it is the nearest."""
    nearest = np.min([np.where(thing.depth_mm > 0, thing.depth_mm, np.inf) for thing in things], axis=0)
    return [(thing, (thing.depth_mm > 0) & (thing.depth_mm == nearest)) for thing in things]


def _point(camera: Camera, rng: Rng, depth_mm: float, radius_mm: float) -> Float[np.ndarray, " 3"]:
    """A point at that depth around which a sphere lies inside the image, as far as there is one."""
    h, w = camera.size_hw
    margin = np.minimum(1.08 * radius_mm / (depth_mm - radius_mm) * camera.K[0, 0] + 2, np.array([w, h]) / 2 - 1)
    px = rng.uniform(margin, np.array([w, h]) - 1 - margin)
    return np.linalg.inv(camera.K) @ [*px, 1.0] * depth_mm
