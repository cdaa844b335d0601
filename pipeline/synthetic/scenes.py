"""seed -> a BOP dataset of cluttered, partly occluded scenes with exact ground truth."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from PIL import Image
from tqdm import tqdm

from pipeline.errors import BadInput
from pipeline.functional.camera import resize_affine
from pipeline.functional.rigid import rigid
from pipeline.items.objects import Mesh
from pipeline.meshes import diameter_mm, write_ply
from pipeline.stages.render.cameras import bounding_sphere
from pipeline.stages.render.raycast import render_depth, surface_points
from pipeline.synthetic.objects import make_object, random_rotation

SCENE_ID = 1
OCCLUDED = (0.4, 0.9)  # visible fraction of an instance that is meant to be occluded
_FREE = 0.97  # and at least of one that is not
_DEPTH_SCALE = 0.1  # mm per unit of the depth images
_DISTRACTORS = 6  # objects that occlude and clutter, and that no model is given of
_TRIES = 60

Rng = np.random.Generator


@dataclass(frozen=True, eq=False)
class _Camera:
    K: Float[np.ndarray, "3 3"]
    size_hw: tuple[int, int]


@dataclass(frozen=True, eq=False)
class _Thing:
    """An object placed in an image; ``obj_id`` 0 for a distractor. ``limits``: the visible fraction it is to have."""

    obj_id: int
    mesh: Mesh
    T_cam_obj: Float[np.ndarray, "4 4"]
    depth_mm: Float32[np.ndarray, "H W"]
    limits: tuple[float, float]


def _place(
    mesh: Mesh,
    centre_cam: Float[np.ndarray, " 3"],
    camera: _Camera,
    rng: Rng,
    *,
    obj_id: int = 0,
    limits: tuple[float, float] = (0.0, 1.0),
) -> _Thing:
    """The mesh with its centre at a point of the camera frame, turned at random; t is rounded as it will be written."""
    R = random_rotation(rng)
    T = rigid(R, np.round(centre_cam - R @ bounding_sphere(mesh)[0], 4))
    return _Thing(obj_id, mesh, T, render_depth(mesh, camera.K, T[None], camera.size_hw)[0], limits)


def write_dataset(
    root: Path,
    *,
    objects: int = 5,
    images: int = 12,
    seed: int = 0,
    size_hw: tuple[int, int] = (480, 640),
    per_image: int = 5,
    occluded: float = 0.5,
    progress: bool = True,
) -> None:
    """Models and one test scene under ``root``, in the layout that BOP's own datasets have.

    Each image holds ``per_image`` of the objects at 500 to 1000 mm, once each, before a textured wall. A share
    ``occluded`` of them is hidden in part by distractors, to a visible fraction within OCCLUDED; the others are free.
    ``dataset_info.json`` holds the arguments. Camera, light and noise change from image to image. Depth and masks are
    exact but for depth's rounding to 0.1 mm; no object leaves the image. The same arguments give the same bytes.
    Raises BadInput for a ``root`` that is not empty; what is interrupted leaves no ``root``.
    """
    _check(root, objects=objects, images=images, per_image=per_image, occluded=occluded, size_hw=size_hw)
    root.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{root.name}.", suffix=".partial", dir=root.parent))
    try:
        partial.chmod(0o755)
        models = {k + 1: make_object(1000 * seed + k) for k in range(objects)}
        arguments = {"objects": objects, "images": images, "seed": seed, "size_hw": list(size_hw)}
        _write_json(partial / "dataset_info.json", arguments | {"per_image": per_image, "occluded": occluded})
        _write_models(partial, models, size_hw)
        _write_scene(partial, models, images, seed, size_hw, min(per_image, objects), occluded, progress)
        partial.replace(root)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _check(root: Path, *, objects: int, images: int, per_image: int, occluded: float, size_hw: tuple[int, int]) -> None:
    for name, value, low in (("objects", objects, 1), ("images", images, 1), ("per_image", per_image, 1)):
        if value < low:
            raise BadInput(f"synthetic.{name}", found=value, needed=f"at least {low}")
    if not 0 <= occluded <= 1:
        raise BadInput("synthetic.occluded", found=occluded, needed="a share between 0 and 1")
    if min(size_hw) < 64:
        raise BadInput("synthetic.size_hw", found=size_hw, needed="at least 64 pixels a side")
    if root.exists() and (not root.is_dir() or any(root.iterdir())):
        raise BadInput(root, found="something already there", needed="a new or empty folder for the dataset")


def _write_models(root: Path, models: Mapping[int, Mesh], size_hw: tuple[int, int]) -> None:
    info = {str(obj_id): _extent(mesh) for obj_id, mesh in models.items()}
    for folder in (root / "models", root / "models_eval"):
        folder.mkdir()
        _write_json(folder / "models_info.json", info)
        for obj_id, mesh in models.items():
            write_ply(folder / f"obj_{obj_id:06d}.ply", mesh)
    K = _nominal_K(size_hw)
    camera = {"cx": K[0, 2], "cy": K[1, 2], "depth_scale": _DEPTH_SCALE, "fx": K[0, 0], "fy": K[1, 1]}
    _write_json(root / "camera.json", camera | {"height": size_hw[0], "width": size_hw[1]})


def _extent(mesh: Mesh) -> dict[str, float]:
    low, size = mesh.vertices.min(axis=0), np.ptp(mesh.vertices, axis=0)
    corner = {f"min_{axis}": float(value) for axis, value in zip("xyz", low, strict=True)}
    return {"diameter": diameter_mm(mesh)} | corner | {f"size_{a}": float(v) for a, v in zip("xyz", size, strict=True)}


def _write_scene(
    root: Path,
    models: Mapping[int, Mesh],
    images: int,
    seed: int,
    size_hw: tuple[int, int],
    per_image: int,
    occluded: float,
    progress: bool,
) -> None:
    scene = root / "test" / f"{SCENE_ID:06d}"
    for name in ("rgb", "depth", "mask", "mask_visib"):
        (scene / name).mkdir(parents=True)
    distractors = [make_object(1_000_000 + 1000 * seed + k) for k in range(_DISTRACTORS)]
    records: dict[str, dict[str, Any]] = {"scene_camera": {}, "scene_gt": {}, "scene_gt_info": {}}
    targets, meant = [], _shares(images * per_image, occluded, np.random.default_rng([seed, 1]))
    for im_id in tqdm(range(images), desc="synthetic images", disable=not progress):
        rng = np.random.default_rng([seed, 2, im_id])
        camera = _camera(size_hw, rng)
        chosen = sorted(int(k) for k in rng.permutation(list(models))[:per_image])
        hidden = meant[im_id * per_image : (im_id + 1) * per_image]
        things = _arrange([(k, models[k]) for k in chosen], hidden, distractors, camera, rng)
        _write_image(scene, im_id, things, camera, records, rng)
        targets += [{"im_id": im_id, "inst_count": 1, "obj_id": k, "scene_id": SCENE_ID} for k in chosen]
    for name, record in records.items():
        _write_json(scene / f"{name}.json", record)
    _write_json(root / "test_targets_bop19.json", targets)


def _shares(count: int, share: float, rng: Rng) -> Bool[np.ndarray, " n"]:
    """Which of ``count`` instances are to be occluded: exactly the share, rounded."""
    return rng.permutation(np.arange(count) < round(share * count))


def _nominal_K(size_hw: tuple[int, int]) -> Float[np.ndarray, "3 3"]:
    h, w = size_hw
    return np.array([[0.92 * w, 0.0, (w - 1) / 2], [0.0, 0.92 * w, (h - 1) / 2], [0.0, 0.0, 1.0]])


def _camera(size_hw: tuple[int, int], rng: Rng) -> _Camera:
    """The nominal camera with another focal length, slightly unequal pixels and a shifted principal point."""
    K = _nominal_K(size_hw)
    K[[0, 1], [0, 1]] *= rng.uniform(0.93, 1.07) * np.array([1.0, rng.uniform(0.995, 1.005)])
    K[:2, 2] += rng.uniform(-0.03, 0.03, 2) * size_hw[1]
    return _Camera(np.round(K, 5), size_hw)


def _arrange(
    chosen: Sequence[tuple[int, Mesh]],
    hidden: Bool[np.ndarray, " n"],
    distractors: Sequence[Mesh],
    camera: _Camera,
    rng: Rng,
) -> list[_Thing]:
    """The objects side by side, then a distractor before each that is to be hidden, then distractors behind."""
    things: list[_Thing] = []
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
    obj_id: int, mesh: Mesh, limits: tuple[float, float], others: Sequence[_Thing], camera: _Camera, rng: Rng
) -> _Thing:
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
    thing: _Thing,
    things: list[_Thing],
    waiting: Sequence[_Thing],
    distractors: Sequence[Mesh],
    camera: _Camera,
    rng: Rng,
) -> list[_Thing]:
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


def _excess(visible: float, thing: _Thing, *, waits: bool) -> float:
    """How far a visible fraction lies outside the thing's limits; to be seen whole is no fault of one that waits."""
    low, high = thing.limits
    return max(low - visible, 0.0) + (0.0 if waits else max(visible - high, 0.0))


def _fractions(things: Sequence[_Thing]) -> list[float]:
    return [float(visible.sum() / max((thing.depth_mm > 0).sum(), 1)) for thing, visible in _visible(things)]


def _visible(things: Sequence[_Thing]) -> list[tuple[_Thing, Bool[np.ndarray, "H W"]]]:
    """Each thing with the pixels in which it is the nearest."""
    nearest = np.min([np.where(thing.depth_mm > 0, thing.depth_mm, np.inf) for thing in things], axis=0)
    return [(thing, (thing.depth_mm > 0) & (thing.depth_mm == nearest)) for thing in things]


def _point(camera: _Camera, rng: Rng, depth_mm: float, radius_mm: float) -> Float[np.ndarray, " 3"]:
    """A point at that depth around which a sphere lies inside the image, as far as there is one."""
    h, w = camera.size_hw
    margin = np.minimum(1.08 * radius_mm / (depth_mm - radius_mm) * camera.K[0, 0] + 2, np.array([w, h]) / 2 - 1)
    px = rng.uniform(margin, np.array([w, h]) - 1 - margin)
    return np.linalg.inv(camera.K) @ [*px, 1.0] * depth_mm


def _write_image(
    scene: Path, im_id: int, things: Sequence[_Thing], camera: _Camera, records: dict[str, dict[str, Any]], rng: Rng
) -> None:
    wall = _Wall(rng)
    rgb = _photograph(things, wall, camera, rng)
    depth = wall.depth_mm(camera)
    for thing, visible in _visible(things):
        depth = np.where(visible, thing.depth_mm, depth)
    stored = np.rint(depth / _DEPTH_SCALE).astype(np.uint16)
    _write_png(scene / "rgb" / f"{im_id:06d}.png", rgb)
    _write_png(scene / "depth" / f"{im_id:06d}.png", stored)
    poses: list[dict[str, Any]] = []
    infos: list[dict[str, Any]] = []
    for thing, visible in _visible(things):
        if not thing.obj_id:
            continue
        silhouette = thing.depth_mm > 0
        for folder, mask in (("mask", silhouette), ("mask_visib", visible)):
            _write_png(scene / folder / f"{im_id:06d}_{len(poses):06d}.png", mask.astype(np.uint8) * 255)
        poses.append(
            {
                "cam_R_m2c": thing.T_cam_obj[:3, :3].reshape(-1).tolist(),
                "cam_t_m2c": thing.T_cam_obj[:3, 3].tolist(),
                "obj_id": thing.obj_id,
            }
        )
        infos.append(_gt_info(silhouette, visible, stored > 0))
    records["scene_camera"][str(im_id)] = {"cam_K": camera.K.reshape(-1).tolist(), "depth_scale": _DEPTH_SCALE}
    records["scene_gt"][str(im_id)] = poses
    records["scene_gt_info"][str(im_id)] = infos


def _gt_info(
    silhouette: Bool[np.ndarray, "H W"], visible: Bool[np.ndarray, "H W"], measured: Bool[np.ndarray, "H W"]
) -> dict[str, Any]:
    """An instance's entry in scene_gt_info, as bop_toolkit defines it."""
    count_all, count_visible = int(silhouette.sum()), int(visible.sum())
    return {
        "bbox_obj": _bbox_xywh(silhouette),
        "bbox_visib": _bbox_xywh(visible),
        "px_count_all": count_all,
        "px_count_valid": int((silhouette & measured).sum()),
        "px_count_visib": count_visible,
        "visib_fract": count_visible / count_all if count_all else 0.0,
    }


def _bbox_xywh(mask: Bool[np.ndarray, "H W"]) -> list[int]:
    """First column and row, and number of columns and rows; -1 for an empty mask."""
    ys, xs = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(ys):
        return [-1, -1, -1, -1]
    return [int(xs[0]), int(ys[0]), int(xs[-1] - xs[0] + 1), int(ys[-1] - ys[0] + 1)]


class _Wall:
    """A tilted plane behind the scene, 1250 mm away and more, with a random picture on it."""

    def __init__(self, rng: Rng) -> None:
        self.normal = np.array([*rng.uniform(-0.25, 0.25, 2), -1.0])
        self.distance_mm = rng.uniform(1500.0, 1700.0)
        self.picture = _picture(rng)

    def depth_mm(self, camera: _Camera) -> Float[np.ndarray, "H W"]:
        """Depth at pixel centres."""
        x, y = _ray_slopes(camera)
        return -self.distance_mm / (x * self.normal[0] + y * self.normal[1] + self.normal[2])

    def albedo(self, camera: _Camera) -> Float32[np.ndarray, "H W 3"]:
        """The picture as the camera sees it, 0..255."""
        depth_mm = self.depth_mm(camera)
        # 2400 mm of wall to the picture's side cover what a wide camera sees
        x, y = ((ray * depth_mm / 2400.0 + 0.5) * len(self.picture) for ray in _ray_slopes(camera))
        x, y = x.astype(np.float32), y.astype(np.float32)
        seen = cv2.remap(self.picture, x, y, interpolation=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        return np.asarray(seen, dtype=np.float32)


def _ray_slopes(camera: _Camera) -> tuple[Float[np.ndarray, "1 W"], Float[np.ndarray, "H 1"]]:
    """Slopes x / z and y / z of the rays through the columns and rows of pixels; cameras made here have no skew."""
    (h, w), K = camera.size_hw, camera.K
    return (np.arange(w)[None] - K[0, 2]) / K[0, 0], (np.arange(h)[:, None] - K[1, 2]) / K[1, 1]


def _picture(rng: Rng, side: int = 1024) -> Float32[np.ndarray, "s s 3"]:
    """Coloured noise of several scales with shapes painted over it, 0..255."""
    picture = np.zeros((side, side, 3), np.float32)
    for octave in (4, 16, 64, 256):
        shared, own = rng.normal(size=(octave, octave, 1)), rng.normal(size=(octave, octave, 3))
        coarse = (0.85 * shared + 0.35 * own).astype(np.float32)  # surfaces differ more in lightness than in hue
        picture += 40 * (4 / octave) ** 0.4 * cv2.resize(coarse, (side, side), interpolation=cv2.INTER_CUBIC)
    picture += rng.uniform(80, 170, 3).astype(np.float32)
    for _ in range(70):
        centre, reach = rng.uniform(0, side, 2), rng.uniform(10, 90)
        around = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 9))))
        outline = centre + reach * rng.uniform(0.5, 1, (len(around), 1)) * np.stack(
            [np.cos(around), np.sin(around)], -1
        )
        cv2.fillPoly(picture, [np.rint(outline).astype(np.int32)], rng.uniform(20, 235, 3).tolist())
    return np.clip(picture, 0, 255)


def _photograph(things: Sequence[_Thing], wall: _Wall, camera: _Camera, rng: Rng) -> UInt8[np.ndarray, "H W 3"]:
    """The scene at twice the resolution under one light, halved, blurred as a lens does, with sensor noise."""
    h, w = camera.size_hw
    fine = _Camera(resize_affine(2.0) @ camera.K, (2 * h, 2 * w))
    toward = rng.normal(size=3) * [1, 1, 0.6] + [0, -0.6, -1.0]  # the light comes from the viewer's side, often above
    toward /= np.linalg.norm(toward)
    tint = rng.uniform(0.9, 1.1, 3) * rng.uniform(0.85, 1.15)
    ambient, diffuse, gloss = rng.uniform(0.3, 0.5), rng.uniform(0.5, 0.8), rng.uniform(0.0, 0.25)
    image = wall.albedo(fine) * np.float32(ambient + diffuse * 0.6)
    nearest = np.full(fine.size_hw, np.inf, np.float32)
    half = toward + np.array([0.0, 0.0, -1.0])  # Blinn's highlight, for a viewer straight ahead
    half /= np.linalg.norm(half)
    for thing in things:
        px, albedo, normal, depth = surface_points(thing.mesh, fine.K, thing.T_cam_obj, fine.size_hw)
        front = depth < nearest[px[:, 1], px[:, 0]]
        x, y = px[front].T
        nearest[y, x] = depth[front]
        cos = np.maximum(normal[front] @ toward, 0)[:, None]
        shine = np.maximum(normal[front] @ half, 0)[:, None] ** 30
        image[y, x] = albedo[front] * (ambient + diffuse * cos) + 255 * gloss * shine
    small = cv2.resize(image * tint.astype(np.float32), (w, h), interpolation=cv2.INTER_AREA)
    blurred = np.asarray(cv2.GaussianBlur(small, (0, 0), 0.5))
    return np.clip(np.rint(blurred + rng.normal(0, 2.0, blurred.shape)), 0, 255).astype(np.uint8)


def _write_png(path: Path, image: np.ndarray) -> None:
    Image.fromarray(image).save(path, compress_level=6)


def _write_json(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=1) + "\n")
