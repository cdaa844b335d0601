"""seed -> a BOP dataset of cluttered, partly occluded scenes with exact ground truth."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool
from PIL import Image
from tqdm import tqdm

from pipeline.errors import BadInput
from pipeline.io.meshes import diameter_mm, write_ply
from pipeline.items.objects import Mesh
from pipeline.synthetic.layout import Camera, PlacedObject, arrange, nominal_K, random_camera, visible_parts
from pipeline.synthetic.objects import make_object
from pipeline.synthetic.parts import Rng
from pipeline.synthetic.photograph import Wall, render_photograph

SCENE_ID = 1
GENERATOR_VERSION = 1
"""Raise it when the same arguments give other images, poses or meshes: datasets of other versions are not used."""
INFO = "dataset_info.json"
_DEPTH_SCALE = 0.1  # mm per unit of the depth images
_DISTRACTORS = 6  # objects that occlude and clutter; the dataset has no models of them


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
    """Write models and one test scene to ``root`` in BOP's layout; ``dataset_info.json`` holds the arguments.

    Each image shows ``per_image`` different objects at 500 to 1000 mm in front of a textured wall. A share ``occluded``
    of them is partly hidden by distractors, to a visible fraction within OCCLUDED; the others are free. Camera, light
    and noise vary between images. No object extends beyond the image. Masks are exact, depth is rounded to 0.1 mm.
    The same arguments give the same bytes. Raises BadInput if ``root`` is not empty; an interrupted call leaves no
    ``root``.
    """
    _check(root, objects=objects, images=images, per_image=per_image, occluded=occluded, size_hw=size_hw)
    root.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{root.name}.", suffix=".partial", dir=root.parent))
    try:
        partial.chmod(0o755)
        models = {k + 1: make_object(1000 * seed + k) for k in range(objects)}
        arguments = {"objects": objects, "images": images, "seed": seed, "size_hw": list(size_hw)}
        arguments |= {"per_image": per_image, "occluded": occluded, "generator": GENERATOR_VERSION}
        _write_json(partial / INFO, arguments)
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
    info = {str(obj_id): describe_extent(mesh) for obj_id, mesh in models.items()}
    for folder in (root / "models", root / "models_eval"):
        folder.mkdir()
        _write_json(folder / "models_info.json", info)
        for obj_id, mesh in models.items():
            write_ply(folder / f"obj_{obj_id:06d}.ply", mesh)
    K = nominal_K(size_hw)
    camera = {"cx": K[0, 2], "cy": K[1, 2], "depth_scale": _DEPTH_SCALE, "fx": K[0, 0], "fy": K[1, 1]}
    _write_json(root / "camera.json", camera | {"height": size_hw[0], "width": size_hw[1]})


def describe_extent(mesh: Mesh) -> dict[str, float]:
    """A mesh's entry in models_info.json without symmetries, mm: diameter, lower corner and size of its box."""
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
    targets, occluded_mask = [], _choose_occluded(images * per_image, occluded, np.random.default_rng([seed, 1]))
    for im_id in tqdm(range(images), desc="synthetic images", disable=not progress):
        rng = np.random.default_rng([seed, 2, im_id])
        camera = random_camera(size_hw, rng)
        chosen = sorted(int(k) for k in rng.permutation(list(models))[:per_image])
        hidden = occluded_mask[im_id * per_image : (im_id + 1) * per_image]
        placed_objects = arrange([(k, models[k]) for k in chosen], hidden, distractors, camera, rng)
        _write_image(scene, im_id, placed_objects, camera, records, rng)
        targets += [{"im_id": im_id, "inst_count": 1, "obj_id": k, "scene_id": SCENE_ID} for k in chosen]
    for name, record in records.items():
        _write_json(scene / f"{name}.json", record)
    _write_json(root / "test_targets_bop19.json", targets)


def _choose_occluded(count: int, share: float, rng: Rng) -> Bool[np.ndarray, " n"]:
    """Random mask of the ``count`` instances that are to be occluded: exactly the share, rounded."""
    return rng.permutation(np.arange(count) < round(share * count))


def _write_image(
    scene: Path,
    im_id: int,
    placed_objects: Sequence[PlacedObject],
    camera: Camera,
    records: dict[str, dict[str, Any]],
    rng: Rng,
) -> None:
    wall = Wall(rng)
    rgb = render_photograph(placed_objects, wall, camera, rng)
    depth = wall.depth_mm(camera)
    for placed, visible in visible_parts(placed_objects):
        depth = np.where(visible, placed.depth_mm, depth)
    stored = np.rint(depth / _DEPTH_SCALE).astype(np.uint16)
    _write_png(scene / "rgb" / f"{im_id:06d}.png", rgb)
    _write_png(scene / "depth" / f"{im_id:06d}.png", stored)
    poses: list[dict[str, Any]] = []
    infos: list[dict[str, Any]] = []
    for placed, visible in visible_parts(placed_objects):
        if not placed.obj_id:
            continue
        silhouette = placed.depth_mm > 0
        for folder, mask in (("mask", silhouette), ("mask_visib", visible)):
            _write_png(scene / folder / f"{im_id:06d}_{len(poses):06d}.png", mask.astype(np.uint8) * 255)
        poses.append(
            {
                "cam_R_m2c": placed.T_cam_obj[:3, :3].reshape(-1).tolist(),
                "cam_t_m2c": placed.T_cam_obj[:3, 3].tolist(),
                "obj_id": placed.obj_id,
            }
        )
        infos.append(describe_instance(silhouette, visible, stored > 0))
    records["scene_camera"][str(im_id)] = {"cam_K": camera.K.reshape(-1).tolist(), "depth_scale": _DEPTH_SCALE}
    records["scene_gt"][str(im_id)] = poses
    records["scene_gt_info"][str(im_id)] = infos


def describe_instance(
    silhouette: Bool[np.ndarray, "H W"], visible: Bool[np.ndarray, "H W"], measured: Bool[np.ndarray, "H W"]
) -> dict[str, Any]:
    """An instance's entry in scene_gt_info.json, as bop_toolkit defines it."""
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
    """First column and row, number of columns and rows; all -1 for an empty mask."""
    ys, xs = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(ys):
        return [-1, -1, -1, -1]
    return [int(xs[0]), int(ys[0]), int(xs[-1] - xs[0] + 1), int(ys[-1] - ys[0] + 1)]


def _write_png(path: Path, image: np.ndarray) -> None:
    Image.fromarray(image).save(path, compress_level=6)


def _write_json(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=1) + "\n")
