"""seed -> procedural scenes meant to be as hard as photographs, to fit and measure confidence.

Templates are rendered from scan-like meshes (other colours, baked-in light, a smoother and slightly wrong surface, or
no colours at all); photographs show the true objects and are blurred, noisy and compressed. Detections have the
errors of a detector: masks are rough, too large, cut, or of another object, and some are boxes only. Some detections
are of an object that is not in the image ("wrong mesh").
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, UInt8
from PIL import Image
from tqdm import tqdm

from pipeline.bop.masks import encode_rle
from pipeline.embedded.shapes import make_training_object
from pipeline.functional.camera import mask_bbox
from pipeline.io.meshes import diameter_mm, write_ply
from pipeline.items.objects import Mesh
from pipeline.synthetic.detector_masks import imitate_detector
from pipeline.synthetic.layout import PlacedObject, arrange, random_camera, visible_parts
from pipeline.synthetic.objects import make_object
from pipeline.synthetic.parts import Rng, random_direction, smooth_noise
from pipeline.synthetic.photograph import Wall, render_photograph
from pipeline.synthetic.scenes import describe_extent, describe_instance

CASES = "cases.json"
SIZE_HW = (360, 480)
OTHER_SHAPES = 50_000_000  # first seed of objects of the training generator; training used seeds below 1,000,000
_FEWEST_PIXELS = 250
_WRONG_MESH = 0.4  # of the instances get a further detection, of an object that is not in the image


@dataclass(frozen=True, eq=False)
class Case:
    """One detection and its ground truth. ``T_cam_obj``: None if the detection is of an absent object."""

    im_id: int
    obj_id: int
    nth: int
    T_cam_obj: list[list[float]] | None
    visible: float
    iou: float
    kind: str


def write_validation(root: Path, *, seed: int, objects: int, images: int, per_image: int = 4) -> list[Case]:
    """Write a BOP dataset and its ``detections.json`` to ``root``; returns the cases in the order of the detections."""
    truths = {k + 1: _true_object(seed, k) for k in range(objects)}
    _write_models(root, truths, seed)
    scene = root / "test" / "000001"
    (scene / "rgb").mkdir(parents=True)
    distractors = [make_object(2_000_000 + 1000 * seed + k) for k in range(6)]
    cameras, gts, infos, cases, detections = {}, {}, {}, list[Case](), list[dict[str, Any]]()
    for im_id in tqdm(range(images), desc="validation images"):
        rng = np.random.default_rng([seed, 0xC0F1, im_id])
        camera = random_camera(SIZE_HW, rng)
        chosen = sorted(int(k) for k in rng.permutation(list(truths))[:per_image])
        placed = arrange([(k, truths[k]) for k in chosen], rng.random(len(chosen)) < 0.6, distractors, camera, rng)
        rgb = _degrade(render_photograph(placed, Wall(rng), camera, rng), rng)
        Image.fromarray(rgb).save(scene / "rgb" / f"{im_id:06d}.png", compress_level=1)
        shown = [(p, visible) for p, visible in visible_parts(placed) if p.obj_id]
        cameras[str(im_id)] = {"cam_K": camera.K.reshape(-1).tolist(), "depth_scale": 0.1}
        gts[str(im_id)] = [_pose_record(p) for p, _ in shown]
        infos[str(im_id)] = [describe_instance(p.depth_mm > 0, visible, visible) for p, visible in shown]
        absent = [k for k in truths if k not in chosen]
        for found, detection in _detect(im_id, shown, absent, rng):
            cases.append(found)
            detections.append(detection)
    for name, content in (("scene_camera", cameras), ("scene_gt", gts), ("scene_gt_info", infos)):
        (scene / f"{name}.json").write_text(json.dumps(content))
    asked = sorted({(c.im_id, c.obj_id) for c in cases})
    targets = [{"scene_id": 1, "im_id": i, "obj_id": o, "inst_count": 1} for i, o in asked]
    (root / "test_targets_bop19.json").write_text(json.dumps(targets))
    (root / "detections.json").write_text(json.dumps(detections))
    (root / CASES).write_text(json.dumps([asdict(case) for case in cases]))
    return cases


def read_cases(root: Path) -> list[Case]:
    """The cases that ``write_validation`` wrote."""
    return [Case(**record) for record in json.loads((root / CASES).read_text())]


def _true_object(seed: int, k: int) -> Mesh:
    """Every third object is from the demo's generator, the others from that of training objects, with other seeds."""
    if k % 3 == 0:
        return make_object(3_000_000 + 1000 * seed + k // 3)
    mesh = make_training_object(OTHER_SHAPES + 1000 * seed + k)
    size = np.random.default_rng([seed, k, 5]).uniform(70, 240)
    return replace(mesh, vertices=mesh.vertices * size / diameter_mm(mesh))


def _write_models(root: Path, truths: dict[int, Mesh], seed: int) -> None:
    (root / "models").mkdir(parents=True)
    (root / "models_eval").mkdir()
    info = {str(k): describe_extent(mesh) for k, mesh in truths.items()}
    for folder in ("models", "models_eval"):
        (root / folder / "models_info.json").write_text(json.dumps(info))
    for k, mesh in truths.items():
        write_ply(root / "models" / f"obj_{k:06d}.ply", imitate_scanned_mesh(mesh, np.random.default_rng([seed, 9, k])))
        write_ply(root / "models_eval" / f"obj_{k:06d}.ply", mesh)


def imitate_scanned_mesh(mesh: Mesh, rng: Rng) -> Mesh:
    """The mesh as from a scanner or CAD program: a slightly wrong surface, and colours changed or missing."""
    size = np.ptp(mesh.vertices, axis=0).max()
    away = mesh.vertices / np.maximum(np.linalg.norm(mesh.vertices, axis=1, keepdims=True), 1e-9)
    off = rng.uniform(0, 0.012) * size * smooth_noise(mesh.vertices / size, rng, scale=rng.uniform(0.05, 0.3))
    vertices = mesh.vertices + off[:, None] * away
    if rng.random() < 0.12 or mesh.colours is None:
        return replace(mesh, vertices=vertices, colours=None)
    colour = mesh.colours.astype(float) / 255
    grey = colour.mean(axis=1, keepdims=True)
    light = 1 + rng.choice([0.0, rng.uniform(0.1, 0.45)]) * (away @ random_direction(rng))
    light = light + rng.uniform(0, 0.12) * smooth_noise(mesh.vertices / size, rng, scale=rng.uniform(0.05, 0.5))
    colour = np.clip(grey + rng.uniform(0.4, 1.2) * (colour - grey), 0, 1) ** np.exp(rng.uniform(-0.4, 0.4))
    colour = colour * rng.uniform(0.75, 1.2, 3) * light[:, None]
    return replace(mesh, vertices=vertices, colours=(255 * colour.clip(0, 1)).astype(np.uint8))


def _degrade(rgb: UInt8[np.ndarray, "H W 3"], rng: Rng) -> UInt8[np.ndarray, "H W 3"]:
    """Simulate a cheap camera: exposure, colour cast, blur, noise and compression."""
    image = (rgb / 255.0) ** np.exp(rng.uniform(-0.45, 0.45)) * rng.uniform(0.6, 1.15) * rng.uniform(0.85, 1.1, 3)
    sigma = rng.choice([0.0, rng.uniform(0.4, 1.6)])
    image = cv2.GaussianBlur(image, (0, 0), sigma) if sigma else image
    image = image + rng.normal(0, rng.uniform(0.004, 0.03), image.shape)
    pixels = (255 * image.clip(0, 1)).astype(np.uint8)
    _, packed = cv2.imencode(".jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(45, 95))])
    decoded = cv2.imdecode(packed, cv2.IMREAD_COLOR)
    assert decoded is not None
    return np.ascontiguousarray(decoded[..., ::-1])


def _pose_record(placed: PlacedObject) -> dict[str, Any]:
    T = placed.T_cam_obj
    return {"cam_R_m2c": T[:3, :3].reshape(-1).tolist(), "cam_t_m2c": T[:3, 3].tolist(), "obj_id": placed.obj_id}


def _detect(
    im_id: int, shown: Sequence[tuple[PlacedObject, Bool[np.ndarray, "H W"]]], absent: Sequence[int], rng: Rng
) -> list[tuple[Case, dict[str, Any]]]:
    """Two detections of each visible instance, and for some a third, of an absent object."""
    found, ranks = list[tuple[Case, dict[str, Any]]](), dict[int, int]()

    def add(obj_id: int, T: list[list[float]] | None, visible: float, mask: np.ndarray, iou: float, kind: str) -> None:
        nth = ranks.get(obj_id, 0)
        ranks[obj_id] = nth + 1
        box = mask_bbox(mask)
        assert box is not None
        x0, y0, x1, y1 = box
        score = round(0.99 - 0.01 * nth, 6)
        record: dict[str, Any] = {"scene_id": 1, "image_id": im_id, "category_id": obj_id, "score": score}
        record |= {"bbox": [x0 + 0.5, y0 + 0.5, x1 - x0, y1 - y0], "time": 0.0}
        if kind != "box":
            record["segmentation"] = encode_rle(mask)
        found.append((Case(im_id, obj_id, nth, T, visible, iou, kind), record))

    for placed, visible in shown:
        share = visible.sum() / max((placed.depth_mm > 0).sum(), 1)
        if visible.sum() < _FEWEST_PIXELS:
            continue
        others = [v for p, v in shown if p is not placed]
        silhouette = placed.depth_mm > 0
        for wrong in (False, False, True):
            imitated = imitate_detector(visible, silhouette, others, rng)
            if imitated is None or (wrong and (not absent or rng.random() > _WRONG_MESH)):
                continue
            mask, is_box = imitated
            if wrong:
                add(int(rng.choice(absent)), None, float(share), mask, 0.0, "wrong mesh")
            else:
                iou = float((mask & visible).sum() / (mask | visible).sum())
                add(placed.obj_id, placed.T_cam_obj.tolist(), float(share), mask, iou, "box" if is_box else "mask")
    return found
