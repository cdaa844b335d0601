"""The data set on which choices of the method are made: procedural, small, washed out, with a detector's masks."""

from __future__ import annotations

import json
import shutil
import tempfile
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from pipeline.bop.dataset import Dataset, open_dataset
from pipeline.bop.masks import encode_rle
from pipeline.errors import BadInput
from pipeline.io.meshes import write_ply
from pipeline.items.objects import Mesh
from pipeline.spec import Positive, Spec, spec
from pipeline.synthetic.detector_masks import box_xywh, imitate_detector
from pipeline.synthetic.objects import make_object
from pipeline.synthetic.parts import Rng, random_direction
from pipeline.synthetic.scenes import SCENE_ID, write_dataset

VERSION = 1
SEED = 5150  # neither of training nor of the other measurements
SIZE_HW = (300, 400)  # objects of 30 to 110 px, as in photographs of a table
DONE = "validation.json"


@spec
class ValidationConfig(Spec):
    """Objects as scans show them (light baked in, pale, blurred), poorer photographs, and a detector's masks.

    ``root`` is the folder of the data set; ``detections.json`` in it has masks as detectors make them (detector_masks).
    """

    kind: ClassVar[str] = "dataset.validation"

    root: str = "data/validation"
    name: str = "validation"
    objects: Positive = 10
    images: Positive = 24
    per_image: Positive = 6

    def open(self) -> Dataset:
        """The dataset. Raises BadInput if its folder holds other files, or cannot be written."""
        root = Path(self.root).expanduser()
        made = {"version": VERSION, "objects": self.objects, "images": self.images, "per_image": self.per_image}
        if not root.exists():
            print(f"writing {self.images} images of {self.objects} procedural objects to {root}", flush=True)
            try:
                _write(root, made)
            except OSError as error:
                if not (root / DONE).is_file():  # otherwise another process wrote the same bytes first
                    found = f"{root} ({error.strerror})"
                    raise BadInput("dataset.root", found=found, needed="a folder to write to") from None
        if not (root / DONE).is_file() or json.loads((root / DONE).read_text()) != made:
            needed = f"what {made} gives: delete it, and it is written again, or name another folder"
            raise BadInput("dataset.root", found=f"{root} with other content", needed=needed)
        return open_dataset(root, name=self.name)


def _write(root: Path, made: dict[str, int]) -> None:
    root.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{root.name}.", suffix=".partial", dir=root.parent))
    objects, images, per_image = (made[name] for name in ("objects", "images", "per_image"))
    try:
        scenes = partial / root.name
        write_dataset(
            scenes, objects=objects, images=images, per_image=per_image, seed=SEED, size_hw=SIZE_HW, occluded=0.6
        )
        for k in range(objects):
            mesh, rng = make_object(1000 * SEED + k), np.random.default_rng([SEED, 3, k])
            write_ply(scenes / "models" / f"obj_{k + 1:06d}.ply", _imitate_scan(mesh, rng))
        scene = scenes / "test" / f"{SCENE_ID:06d}"
        for path in sorted((scene / "rgb").iterdir()):
            image = _degrade(np.array(Image.open(path)), np.random.default_rng([SEED, 4, int(path.stem)]))
            Image.fromarray(image).save(path)
        (scenes / "detections.json").write_text(json.dumps(_detect(scene)))
        (scenes / DONE).write_text(json.dumps(made))
        scenes.replace(root)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _imitate_scan(mesh: Mesh, rng: Rng) -> Mesh:
    """The mesh with light baked into paler, blurred colours of another tint."""
    assert mesh.colours is not None
    colours = _smooth_along_edges(mesh.colours / 255.0, mesh, rounds=2)
    corners = mesh.vertices[mesh.faces]
    normal = np.zeros_like(mesh.vertices)
    for corner in range(3):
        np.add.at(normal, mesh.faces[:, corner], np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    light = 0.65 + 0.35 * np.maximum(normal @ random_direction(rng), 0)[:, None]
    grey = colours.mean(1, keepdims=True)
    pale = (grey + rng.uniform(0.4, 0.9) * (colours - grey)) ** np.exp(rng.uniform(-0.3, 0.3))
    tinted = np.clip(pale * light * rng.uniform(0.8, 1.15, 3), 0, 1)
    return Mesh(mesh.vertices, mesh.faces, colours=np.rint(255 * tinted).astype(np.uint8))


def _smooth_along_edges(colours: Float[np.ndarray, "v 3"], mesh: Mesh, *, rounds: int) -> Float[np.ndarray, "v 3"]:
    """Means over neighbouring vertices."""
    a, b = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]).T
    for _ in range(rounds):
        total, count = colours.copy(), np.ones((len(colours), 1))
        for to, other in ((a, b), (b, a)):
            np.add.at(total, to, colours[other])
            np.add.at(count, to, 1)
        colours = total / count
    return colours


def _degrade(rgb: UInt8[np.ndarray, "h w 3"], rng: Rng) -> UInt8[np.ndarray, "h w 3"]:
    """Another white balance and gamma, blur, sensor noise and JPEG's artefacts."""
    image = (rgb / 255.0) ** np.exp(rng.uniform(-0.35, 0.35)) * rng.uniform(0.8, 1.1, 3)
    image = np.asarray(cv2.GaussianBlur(image, (0, 0), rng.uniform(0.4, 1.0)))
    image = np.clip(255 * image + rng.normal(0, rng.uniform(2, 6), image.shape), 0, 255).astype(np.uint8)
    quality = int(rng.integers(60, 90))
    _, coded = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.ascontiguousarray(np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), np.uint8)[..., ::-1])


def _detect(scene: Path) -> list[dict[str, Any]]:
    """Entries of a detections file: one for most instances, with the mask of an imitated detector."""
    truths, entries = json.loads((scene / "scene_gt.json").read_text()), list[dict[str, Any]]()
    for im_id in sorted(map(int, truths)):
        names = [f"{im_id:06d}_{k:06d}.png" for k in range(len(truths[str(im_id)]))]
        full, visible = (
            [np.array(Image.open(scene / folder / name)) > 0 for name in names] for folder in ("mask", "mask_visib")
        )
        for k, truth in enumerate(truths[str(im_id)]):
            others = [v for j, v in enumerate(visible) if j != k]
            found = imitate_detector(visible[k], full[k], others, np.random.default_rng([SEED, 5, im_id, k]))
            if found is None:
                continue
            mask, as_box = found
            ids = {"scene_id": SCENE_ID, "image_id": im_id, "category_id": truth["obj_id"]}
            entry = ids | {"score": 1.0, "time": 0.0, "bbox": box_xywh(mask)}
            entries.append(entry if as_box else entry | {"segmentation": encode_rle(mask)})
    return entries
