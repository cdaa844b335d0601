"""Writes a BOP dataset of two boxes in two images of 64 x 48, exact in everything, for tests that break it."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

SIZE_HW = (48, 64)
K = [80.0, 0.0, 31.5, 0.0, 80.0, 23.5, 0.0, 0.0, 1.0]
HALF_MM = {1: (20.0, 30.0, 10.0), 2: (15.0, 15.0, 40.0)}
# scene 7: image 0 shows object 1 twice and object 2 once, image 3 shows object 2
POSES = {
    0: [(1, (-60.0, 0.0, 400.0)), (1, (60.0, 10.0, 400.0)), (2, (0.0, -40.0, 500.0))],
    3: [(2, (10.0, 0.0, 400.0))],
}
VISIB_FRACT = {0: [0.5, 1.0, 1.0], 3: [1.0]}
FACES = [(0, 2, 1), (1, 2, 3), (4, 5, 6), (5, 7, 6), (0, 1, 4), (1, 5, 4), (2, 6, 3), (3, 6, 7), (0, 4, 2), (2, 4, 6)]
FACES += [(1, 3, 5), (3, 7, 5)]


def write_tiny_bop(root: Path) -> Path:
    """The dataset's root. Objects are not turned, so that masks are the rectangles that their near faces cover."""
    scene = root / "test" / "000007"
    for folder in ("rgb", "depth", "mask", "mask_visib"):
        (scene / folder).mkdir(parents=True)
    _write_models(root / "models")
    camera, gt, info = {}, {}, {}
    for im_id, poses in POSES.items():
        rgb = np.random.default_rng(im_id).integers(0, 256, (*SIZE_HW, 3), dtype=np.uint8)
        Image.fromarray(rgb).save(scene / "rgb" / f"{im_id:06d}.png")
        Image.fromarray(np.full(SIZE_HW, 4000, np.uint16)).save(scene / "depth" / f"{im_id:06d}.png")
        camera[im_id] = {"cam_K": K, "depth_scale": 0.1}
        gt[im_id] = [
            {"cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": list(t), "obj_id": obj_id} for obj_id, t in poses
        ]
        info[im_id] = []
        for gt_id, (obj_id, t) in enumerate(poses):
            x0, y0, x1, y1 = rectangle(obj_id, t)
            mask = np.zeros(SIZE_HW, np.uint8)
            mask[y0 : y1 + 1, x0 : x1 + 1] = 255
            for folder in ("mask", "mask_visib"):
                Image.fromarray(mask).save(scene / folder / f"{im_id:06d}_{gt_id:06d}.png")
            box = [x0, y0, x1 - x0 + 1, y1 - y0 + 1]
            info[im_id].append({"bbox_obj": box, "bbox_visib": box, "visib_fract": VISIB_FRACT[im_id][gt_id]})
    write_json(scene / "scene_camera.json", camera)
    write_json(scene / "scene_gt.json", gt)
    write_json(scene / "scene_gt_info.json", info)
    targets = [(7, 0, 1, 2), (7, 0, 2, 1), (7, 3, 2, 1)]
    names = ("scene_id", "im_id", "obj_id", "inst_count")
    write_json(root / "test_targets_bop19.json", [dict(zip(names, target, strict=True)) for target in targets])
    return root


def rectangle(obj_id: int, t: tuple[float, float, float]) -> tuple[int, int, int, int]:
    """First and last column and row (x0, y0, x1, y1) of the near face."""
    half, near = np.array(HALF_MM[obj_id]), t[2] - HALF_MM[obj_id][2]
    corners = [np.array(K).reshape(3, 3) @ (t[0] + s * half[0], t[1] + s * half[1], near) / near for s in (-1, 1)]
    low, high = np.ceil(corners[0][:2]), np.floor(corners[1][:2])
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def write_json(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value))


def edit_json(path: Path, edit: Any) -> None:
    """Rewrite a JSON file after ``edit(content)`` changed it in place."""
    content = json.loads(path.read_text())
    edit(content)
    write_json(path, content)


def write_box_ply(path: Path, half_mm: tuple[float, float, float]) -> None:
    corners = [[h if i >> axis & 1 else -h for axis, h in enumerate(half_mm)] for i in range(8)]
    header = ["ply", "format ascii 1.0", "element vertex 8", *(f"property float {axis}" for axis in "xyz")]
    header += [f"element face {len(FACES)}", "property list uchar int vertex_indices", "end_header"]
    rows = [" ".join(map(str, corner)) for corner in corners] + [f"3 {a} {b} {c}" for a, b, c in FACES]
    path.write_text("\n".join([*header, *rows, ""]))


def _write_models(folder: Path) -> None:
    folder.mkdir()
    info = {}
    for obj_id, half in HALF_MM.items():
        write_box_ply(folder / f"obj_{obj_id:06d}.ply", half)
        low = {f"min_{axis}": -h for axis, h in zip("xyz", half, strict=True)}
        size = {f"size_{axis}": 2 * h for axis, h in zip("xyz", half, strict=True)}
        info[obj_id] = {"diameter": 2 * float(np.linalg.norm(half))} | low | size
    write_json(folder / "models_info.json", info)
