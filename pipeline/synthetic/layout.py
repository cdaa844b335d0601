"""seed -> objects placed in front of a camera, some of them partly hidden to a given degree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32

from pipeline.functional.rigid import rigid
from pipeline.items.objects import Mesh
from pipeline.stages.render.cameras import bounding_sphere
from pipeline.stages.render.raycast import render_depth
from pipeline.synthetic.parts import Rng, random_rotation

OCCLUDED = (0.4, 0.9)  # limits of the visible fraction of an instance that is to be occluded
_FREE = 0.97  # minimum of one that is not
_TRIES = 60


@dataclass(frozen=True, eq=False)
class Camera:
    """The camera of one image."""

    K: Float[np.ndarray, "3 3"]
    size_hw: tuple[int, int]


@dataclass(frozen=True, eq=False)
class PlacedObject:
    """An object in an image. ``obj_id`` is 0 for a distractor. ``limits``: wanted range of its visible fraction."""

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
) -> PlacedObject:
    """The mesh in a random rotation, its centre at ``centre_cam`` (mm); t is rounded as in scene_gt.json."""
    R = random_rotation(rng)
    T = rigid(R, np.round(centre_cam - R @ bounding_sphere(mesh)[0], 4))
    return PlacedObject(obj_id, mesh, T, render_depth(mesh, camera.K, T[None], camera.size_hw)[0], limits)


def nominal_K(size_hw: tuple[int, int]) -> Float[np.ndarray, "3 3"]:
    """The mean camera matrix of all images."""
    h, w = size_hw
    return np.array([[0.92 * w, 0.0, (w - 1) / 2], [0.0, 0.92 * w, (h - 1) / 2], [0.0, 0.0, 1.0]])


def random_camera(size_hw: tuple[int, int], rng: Rng) -> Camera:
    """The nominal camera with a random focal length, aspect ratio and principal point."""
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
) -> list[PlacedObject]:
    """Objects side by side, a distractor in front of each one to be hidden, and two distractors in the background."""
    objects: list[PlacedObject] = []
    for (obj_id, mesh), hide in zip(chosen, hidden, strict=True):
        objects.append(_place_apart(obj_id, mesh, OCCLUDED if hide else (_FREE, 1.0), objects, camera, rng))
    waiting = [placed for placed, hide in zip(objects, hidden, strict=True) if hide]
    while waiting:
        objects = _hide(waiting.pop(), objects, waiting, distractors, camera, rng)
    for mesh in distractors[:2]:
        centre = _draw_centre(camera, rng, rng.uniform(1050, 1150), bounding_sphere(mesh)[1])
        objects.append(_place(mesh, centre, camera, rng))
    return objects


def _place_apart(
    obj_id: int, mesh: Mesh, limits: tuple[float, float], others: Sequence[PlacedObject], camera: Camera, rng: Rng
) -> PlacedObject:
    """Place an object where it overlaps no other in the image, or overlaps least among the places tried."""
    _, radius = bounding_sphere(mesh)
    best, best_overlap = None, np.inf
    for _ in range(_TRIES):
        # large objects are farther away, so that they cover at most about a quarter of the image's width
        depth = rng.uniform(max(500.0, min(6.5 * radius, 900.0)), 1000.0)
        placed = _place(mesh, _draw_centre(camera, rng, depth, radius), camera, rng, obj_id=obj_id, limits=limits)
        silhouette = placed.depth_mm > 0
        overlap = sum(float((silhouette & (other.depth_mm > 0)).sum()) for other in others)
        if overlap < best_overlap:
            best, best_overlap = placed, overlap
        if overlap == 0:
            break
    assert best is not None
    return best


def _hide(
    target: PlacedObject,
    objects: list[PlacedObject],
    waiting: Sequence[PlacedObject],
    distractors: Sequence[Mesh],
    camera: Camera,
    rng: Rng,
) -> list[PlacedObject]:
    """Add a distractor in front of ``target`` such that every object is as visible as wanted, or the best one tried.

    Objects in ``waiting`` are hidden later and may still be more visible.
    """
    centre = target.T_cam_obj[:3, :3] @ bounding_sphere(target.mesh)[0] + target.T_cam_obj[:3, 3]
    best, least = objects, np.inf
    for _ in range(_TRIES):
        mesh = distractors[int(rng.integers(len(distractors)))]
        reach = bounding_sphere(target.mesh)[1] + bounding_sphere(mesh)[1]
        angle, aside = rng.uniform(0, 2 * np.pi), rng.uniform(0.2, 0.9) * reach
        in_front = centre * (1 - (reach + 10) / centre[2]) + aside * np.array([np.cos(angle), np.sin(angle), 0])
        candidate = [*objects, _place(mesh, in_front, camera, rng)]
        excess = sum(
            _excess(visible, other, waits=any(other is w for w in waiting))
            for visible, other in zip(_visible_fractions(candidate), candidate, strict=True)
        )
        if excess < least:
            best, least = candidate, excess
        if excess == 0:
            break
    return best


def _excess(visible: float, placed: PlacedObject, *, waits: bool) -> float:
    """How far a visible fraction is outside the limits; above them is allowed while the object ``waits``."""
    low, high = placed.limits
    return max(low - visible, 0.0) + (0.0 if waits else max(visible - high, 0.0))


def _visible_fractions(objects: Sequence[PlacedObject]) -> list[float]:
    return [float(visible.sum() / max((placed.depth_mm > 0).sum(), 1)) for placed, visible in visible_parts(objects)]


def visible_parts(objects: Sequence[PlacedObject]) -> list[tuple[PlacedObject, Bool[np.ndarray, "H W"]]]:
    """Each object with the mask of pixels in which it is the nearest."""
    nearest = np.min([np.where(placed.depth_mm > 0, placed.depth_mm, np.inf) for placed in objects], axis=0)
    return [(placed, (placed.depth_mm > 0) & (placed.depth_mm == nearest)) for placed in objects]


def _draw_centre(camera: Camera, rng: Rng, depth_mm: float, radius_mm: float) -> Float[np.ndarray, " 3"]:
    """A random point at a depth such that a sphere around it is inside the image, if possible."""
    h, w = camera.size_hw
    margin = np.minimum(1.08 * radius_mm / (depth_mm - radius_mm) * camera.K[0, 0] + 2, np.array([w, h]) / 2 - 1)
    px = rng.uniform(margin, np.array([w, h]) - 1 - margin)
    return np.linalg.inv(camera.K) @ [*px, 1.0] * depth_mm
