"""Every input of a run is in a key: one changed at a time, either a key differs or no byte of any entry does."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest
from graph.perturbation import BASE, Perturbations, TinyRun, changed_specs, first_valid, variant
from make_sam import write_sam
from make_sd15 import write_folder
from make_vit import write_dinov3, write_vit
from safetensors.torch import load_file, save_file
from test_configuration import VARIANTS
from tiny_bop import FACES, edit_json, write_tiny_bop

from pipeline.bop.dataset import open_dataset
from pipeline.bop.images import image_digest
from pipeline.bop.photo import PhotoConfig
from pipeline.errors import BadInput
from pipeline.io.digests import file_digest, track_files
from pipeline.method import DepthFit, SecondLook, Stages
from pipeline.options import Evaluate, Select

NAMES = sorted(f"{path.parent.name}/{path.stem}" for path in VARIANTS)
LOCATIONS = frozenset({"weights", "unet", "revision", "path"})  # their content counts, see the tests of files
K = (80.0, 80.0, 31.5, 23.5)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory) -> Path:
    return write_tiny_bop(tmp_path_factory.mktemp("tiny"))


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("weights")
    write_vit(root / "vit")
    write_vit(root / "dinov2", "dinov2_with_registers")
    write_dinov3(root / "dinov3", depth=12)
    write_folder(root / "sd")
    write_sam(root / "sam")
    return root


def bop(root: Path, stages: Stages = BASE, **settings: Any) -> TinyRun:
    return TinyRun(lambda: open_dataset(root, name="tiny"), stages, **settings)


def photo(root: Path, **given: Any) -> TinyRun:
    scene = root / "test" / "000007"
    config = PhotoConfig(
        mesh=str(root / "models" / "obj_000001.ply"),
        image=str(scene / "rgb" / "000000.png"),
        mask=str(scene / "mask_visib" / "000000_000000.png"),
        K=K,
    )
    return TinyRun(
        replace(config, **given).open, replace(BASE, detect=variant("detect/photo"), depth=DepthFit(use="given"))
    )


def stages_with(name: str, tiny: Path, weights: Path) -> Stages:
    """The base run's stages with one variant, and whatever it needs of the other stages."""
    dino = variant("extract/dino", weights=str(weights / "vit"), input_size=64)
    given: dict[str, dict[str, Any]] = {
        "extract/dino": {"weights": str(weights / "vit"), "input_size": 64, "local_size": 32, "binned": (9,)},
        "extract/dinov2": {"weights": str(weights / "dinov2"), "input_size": 56, "local_size": 28},
        "extract/dinov3": {"weights": str(weights / "dinov3"), "input_size": 64, "local_size": 32},
        "extract/stable_diffusion": {"weights": str(weights / "sd"), "input_size": 64},
        "extract/bk_sdm": {"weights": str(weights / "sd"), "input_size": 64},
        "extract/cleandift": {
            "weights": str(weights / "sd"),
            "input_size": 64,
            "unet": str(weights / "sd" / "unet" / "diffusion_pytorch_model.safetensors"),
        },
        "extract/fusion": {"first": variant("extract/hog"), "second": dino, "layers": ((2, 5), (8, 5), (5, 5))},
        "extract/embedded": {"input_size": 32},
        "extract/random_sd": {"input_size": 32},
        "detect/json": {"path": str(write_detections(tiny / "detections.json"))},
        "match/words": {"layer": 8, "count": 8, "dim": 4, "samples": 200},
        "match/cosine": {"top_k": 2},
        "crop/virtual": {"size": 64},
        "crop/square": {"size": 64},
    }
    if name.startswith("render/"):
        given[name] = {"count": 3, "size": 32}
    if name == "detect/cnos":
        sam = replace(variant("detect/cnos", describe=dino).proposals, weights=str(weights / "sam"), points_per_side=2)
        given[name] = {"describe": dino, "proposals": sam}
    others = {
        "fuse/learned": {"extract": variant("extract/embedded", input_size=128)},
        "correspond/salient": {"extract": dino},
        "match/cosine": {"extract": dino},  # it has a class token
        "segment/grabcut": {"detect": variant("detect/gt_bbox")},
        "segment/none": {"detect": variant("detect/gt_bbox")},
    }
    stage = name.partition("/")[0]
    return replace(BASE, **{stage: variant(name, **given.get(name, {}))}, **others.get(name, {}))


def write_detections(path: Path) -> Path:
    entries = [
        {"scene_id": 7, "image_id": image, "category_id": obj, "score": score, "bbox": box, "time": 0.5}
        for image, obj, score, box in (
            (0, 1, 0.9, [15, 17, 9, 12]), (0, 2, 0.8, [29, 8, 6, 14]), (3, 2, 0.7, [30, 14, 7, 18]),
            (3, 2, 0.6, [31, 15, 7, 17]), (5, 1, 0.5, [1, 1, 5, 5]),
        )
    ]  # fmt: skip
    path.write_text(json.dumps(entries))
    return path


# Fields without another value that this run accepts, and why.
FIXED = {
    "extract/cleandift": {"noise"},  # none
    "fuse/learned": {"layers"},  # what the head was trained on, see CONDITIONAL
}
# Values of other fields at which a field is left out of the key.
CONDITIONAL = [
    ("extract/random_sd", {"noise": "none"}),
    ("extract/random_sd", {"noise": "independent"}),
    ("extract/dino", {"binned": (), "facet": "token"}),
    ("fuse/learned", {"layers": (2, 5, 8, 11)}),
    ("match/words", {"weights": "equal"}),
    ("cluster/kmeans", {"epipolar": False}),
    ("crop/virtual", {"background": "keep"}),
]


@pytest.mark.parametrize("name", NAMES)
def test_every_field_of_a_variant_is_in_a_key(name: str, tiny: Path, weights: Path, record_property):
    stage = name.partition("/")[0]
    run = photo(tiny) if name == "detect/photo" else bop(tiny, stages_with(name, tiny, weights))
    check_fields(name, stage, run, FIXED.get(name, set()), record_property)


@pytest.mark.parametrize(("name", "values"), CONDITIONAL)
def test_a_field_left_out_of_a_key_changes_nothing(name: str, values: dict, tiny: Path, weights: Path, record_property):
    stage, stages = name.partition("/")[0], stages_with(name, tiny, weights)
    run = bop(tiny, replace(stages, **{stage: replace(getattr(stages, stage), **values)}))
    check_fields(name, stage, run, FIXED.get(name, set()), record_property)


def check_fields(name: str, stage: str, run: TinyRun, fixed: set[str], record_property) -> None:
    perturbations, changed = Perturbations(run), set()
    for field, specs in changed_specs(getattr(run.stages, stage), LOCATIONS):
        runs = [replace(run, stages=replace(run.stages, **{stage: spec})) for spec in specs]
        if (accepted := first_valid(runs)) is not None:
            changed.add(field)
            perturbations.change(f"{name}.{field}", accepted)
    spec = getattr(run.stages, stage)
    assert {field.name for field in fields(spec)} - LOCATIONS - fixed <= {field.partition(".")[0] for field in changed}
    report(perturbations, name, record_property)


def test_every_setting_of_a_run_is_in_a_key(tiny: Path, record_property):
    run = bop(tiny)
    perturbations = Perturbations(run)
    perturbations.change("fallback", replace(run, stages=replace(BASE, fallback=True)))
    perturbations.change("second_look", replace(run, stages=replace(BASE, second_look=SecondLook(hypotheses=1))))
    for name, settings in (("select", run.select), ("evaluate", run.evaluate), ("runtime", run.runtime)):
        for field, others in changed_specs(settings, frozenset({"device", "models"})):
            changed = first_valid([replace(run, **{name: other}) for other in others])
            assert changed is not None or name in ("runtime", "select"), field
            if changed is not None:
                perturbations.change(f"{name}.{field}", changed)
    for chosen in ({"objects": (2,)}, {"images": (3,)}, {"images": (0,)}):
        perturbations.change(f"select.{chosen}", replace(run, select=Select(**chosen)))
    for chosen in ({"vsd": False, "vsd_delta_mm": 5.0}, {"correspondences": True}, {"theta_max": 0.25}):
        perturbations.change(f"evaluate.{chosen}", replace(run, evaluate=Evaluate(**chosen)))
    report(perturbations, "settings", record_property)


# --- files ------------------------------------------------------------------------------------------------------------

SCENE = "test/000007"


def pixel(name: str) -> Callable[[Path], None]:
    """Changes one pixel of an image in the middle of what it shows."""

    def edit(root: Path) -> None:
        with PIL.Image.open(root / name) as image:
            values = np.array(image)
        y, x = (int(v.mean()) for v in np.nonzero(values if values.ndim == 2 else values.any(-1)))
        values[y, x] = values[y, x] // 2 if values.dtype != np.uint8 or values.ndim == 3 else 0
        PIL.Image.fromarray(values).save(root / name)

    return edit


def inverted(name: str) -> Callable[[Path], None]:
    """Inverts a photograph: what objects show changes, not only the background."""

    def edit(root: Path) -> None:
        with PIL.Image.open(root / name) as image:
            values = 255 - np.array(image)
        PIL.Image.fromarray(values).save(root / name)

    return edit


def halved(name: str) -> Callable[[Path], None]:
    """Halves every value of a depth image."""

    def edit(root: Path) -> None:
        with PIL.Image.open(root / name) as image:
            values = np.array(image) // 2
        PIL.Image.fromarray(values).save(root / name)

    return edit


def field_of(name: str, *path: Any, value: Any) -> Callable[[Path], None]:
    """Changes one field of a JSON file; ``value`` is the new value, or a function of the old one."""

    def edit(root: Path) -> None:
        def change(content: Any) -> None:
            *parents, last = path
            for step in parents:
                content = content[step]
            content[last] = value(content[last]) if callable(value) else value

        edit_json(root / name, change)

    return edit


def text_of(name: str, old: str, new: str) -> Callable[[Path], None]:
    def edit(root: Path) -> None:
        text = (root / name).read_text()
        assert old in text
        (root / name).write_text(text.replace(old, new, 1))

    return edit


def removed(name: str) -> Callable[[Path], None]:
    return lambda root: (root / name).unlink()


TURNED = [0.995, -0.0998, 0.0, 0.0998, 0.995, 0.0, 0.0, 0.0, 1.0]
SYMMETRY = [-1.0, 0, 0, 0, 0, -1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0]
FILES: dict[str, Callable[[Path], None]] = {
    "image": inverted(f"{SCENE}/rgb/000000.png"),
    "visible mask": pixel(f"{SCENE}/mask_visib/000000_000001.png"),
    "full mask": pixel(f"{SCENE}/mask/000000_000001.png"),
    "missing mask": removed(f"{SCENE}/mask_visib/000000_000001.png"),
    "missing full mask": removed(f"{SCENE}/mask/000000_000001.png"),
    "depth": halved(f"{SCENE}/depth/000000.png"),
    "missing depth": removed(f"{SCENE}/depth/000000.png"),
    "depth_scale": field_of(f"{SCENE}/scene_camera.json", "0", "depth_scale", value=0.05),
    **{f"cam_K[{i}]": field_of(f"{SCENE}/scene_camera.json", "0", "cam_K", i, value=lambda v: v + 0.25)
       for i in (0, 2, 4, 5)},
    "cam_R_m2c": field_of(f"{SCENE}/scene_gt.json", "0", 1, "cam_R_m2c", value=TURNED),
    "cam_t_m2c": field_of(f"{SCENE}/scene_gt.json", "0", 1, "cam_t_m2c", 2, value=402.0),
    "cam_t_m2c of another image": field_of(f"{SCENE}/scene_gt.json", "3", 0, "cam_t_m2c", 0, value=9),
    "obj_id": field_of(f"{SCENE}/scene_gt.json", "0", 2, "obj_id", value=1),
    "bbox_obj": field_of(f"{SCENE}/scene_gt_info.json", "0", 1, "bbox_obj", 2, value=lambda v: v + 1),
    "bbox_visib": field_of(f"{SCENE}/scene_gt_info.json", "0", 1, "bbox_visib", 2, value=lambda v: v + 1),
    "visib_fract": field_of(f"{SCENE}/scene_gt_info.json", "0", 0, "visib_fract", value=0.75),
    "order of visib_fract": field_of(f"{SCENE}/scene_gt_info.json", "0", 1, "visib_fract", value=0.25),
    "inst_count": field_of("test_targets_bop19.json", 0, "inst_count", value=1),
    "fewer targets": lambda root: edit_json(root / "test_targets_bop19.json", lambda targets: targets.pop()),
    "no targets file": removed("test_targets_bop19.json"),
    "diameter": field_of("models/models_info.json", "1", "diameter", value=lambda v: 1.02 * v),
    "symmetries_discrete": lambda root: edit_json(
        root / "models/models_info.json", lambda info: info["1"].update(symmetries_discrete=[SYMMETRY])),
    "symmetries_continuous": lambda root: edit_json(
        root / "models/models_info.json",
        lambda info: info["1"].update(symmetries_continuous=[{"axis": [0, 0, 1], "offset": [0, 0, 0]}])),
    "size_x": field_of("models/models_info.json", "1", "size_x", value=lambda v: v + 1),
    "no models_info": removed("models/models_info.json"),
    "vertex": text_of("models/obj_000001.ply", "20.0 30.0 10.0", "20.0 30.0 11.0"),
    "face": text_of("models/obj_000001.ply", "3 0 2 1", "3 1 2 3"),
    "vertex of models_eval": text_of("models_eval/obj_000001.ply", "20.0 30.0 10.0", "20.0 30.0 11.0"),
    "diameter of models_eval": field_of("models_eval/models_info.json", "1", "diameter", value=lambda v: 1.02 * v),
    "symmetries of models_eval": lambda root: edit_json(
        root / "models_eval/models_info.json", lambda info: info["2"].update(symmetries_discrete=[SYMMETRY])),
    "no models_eval": lambda root: shutil.rmtree(root / "models_eval"),
    "texture": pixel("models/skin.png"),
    "score of a detection": field_of("detections.json", 0, "score", value=0.95),
    "box of a detection": field_of("detections.json", 1, "bbox", 2, value=7),
    "time of a detection": field_of("detections.json", 1, "time", value=0.7),
    "mask of a detection": lambda root: edit_json(root / "detections.json", lambda found: found[0].update(
        segmentation={"size": [48, 64], "counts": [1000, 10, 38, 10, 48 * 64 - 1058]})),
    "detection of another image": field_of("detections.json", 4, "score", value=0.1),
    "camera.json": lambda root: (root / "camera.json").write_text(json.dumps({"width": 1280, "depth_scale": 1.0})),
}  # fmt: skip


def write_dataset(root: Path) -> Path:
    """The tiny dataset with meshes for scoring of their own, a texture on one object and a file of detections."""
    write_tiny_bop(root)
    shutil.copytree(root / "models", root / "models_eval")
    write_textured_box(root / "models" / "obj_000002.ply")
    write_detections(root / "detections.json")
    return root


def write_textured_box(path: Path) -> None:
    """The second box with a texture, as BOP's ply files have it."""
    lines = path.read_text().splitlines()
    end, at = lines.index("end_header"), lines.index("property float z")
    header = [*lines[:2], "comment TextureFile skin.png", *lines[2 : at + 1]]
    header += ["property float texture_u", "property float texture_v", *lines[at + 1 : end + 1]]
    vertices = [f"{line} {i % 2} {i // 2 % 2}" for i, line in enumerate(lines[end + 1 : end + 9])]
    path.write_text("\n".join([*header, *vertices, *lines[end + 9 :], ""]))
    rng = np.random.default_rng(0)
    PIL.Image.fromarray(rng.integers(1, 256, (8, 8, 3), dtype=np.uint8)).save(path.parent / "skin.png")


def stages_of(reader: str, root: Path) -> Stages:
    """Stages that together read every file: with true poses, so that small changes of depth show in scores."""
    oracle = {"extract": variant("extract/coordinates"), "match": variant("match/oracle")}
    return {
        "masks": BASE,
        "oracle, full masks": replace(BASE, **oracle, detect=variant("detect/gt_mask", visible=False)),
        "true correspondences": replace(
            BASE, **oracle, correspond=variant("correspond/oracle"), second_look=SecondLook(hypotheses=1)
        ),
        "boxes": replace(BASE, detect=variant("detect/gt_bbox", bbox="obj"), crop=variant("crop/square", size=64)),
        "visible boxes": replace(BASE, detect=variant("detect/gt_bbox"), segment=variant("segment/grabcut")),
        "detections": replace(BASE, detect=variant("detect/json", path=str(root / "detections.json"))),
    }[reader]


READERS = ("masks", "oracle, full masks", "true correspondences", "boxes", "visible boxes", "detections")


def check_files(tmp_path: Path, reader: str, record_property, *, thorough: bool) -> None:
    original = write_dataset(tmp_path / "original")
    perturbations = Perturbations(bop(original, stages_of(reader, original)))
    perturbations.contents()
    for number, (name, edit) in enumerate(FILES.items()):
        root = tmp_path / str(number)
        shutil.copytree(original, root)
        edit(root)
        try:
            perturbations.change(name, bop(root, stages_of(reader, root)), thorough=thorough)
        except BadInput:  # a run without it is refused
            assert name in ("no targets file", "no models_info", "obj_id"), name
    report(perturbations, f"files read with {reader}", record_property)


@pytest.mark.slow
@pytest.mark.parametrize("reader", READERS)
def test_every_file_of_a_dataset_is_in_a_key(reader: str, tmp_path: Path, record_property):
    check_files(tmp_path, reader, record_property, thorough=False)


@pytest.mark.faults
@pytest.mark.parametrize("reader", READERS)
def test_entries_of_one_key_have_the_same_bytes_whatever_file_changed(reader: str, tmp_path: Path, record_property):
    check_files(tmp_path, reader, record_property, thorough=True)


def test_every_input_of_a_photograph_is_in_a_key(tmp_path: Path, record_property, monkeypatch):
    monkeypatch.setattr("pipeline.io.meshes.bake._SAMPLES", 20_000)  # a coarse bake of colours in seconds, not minutes
    monkeypatch.setattr("pipeline.io.meshes.bake._TEXELS", 5_000)
    root = write_dataset(tmp_path / "original")
    mesh = write_obj(root / "models" / "box.obj")
    given: dict[str, Any] = {"mesh": str(mesh)}
    perturbations = Perturbations(photo(root, **given))
    perturbations.contents()
    box = {"mask": None, "bbox": (15.0, 17.0, 9.0, 12.0)}
    changes: dict[str, dict[str, Any]] = {
        **{f"K[{i}]": {"K": tuple(v + 0.25 * (i == k) for k, v in enumerate(K))} for i in range(4)},
        "scale": {"scale": 1.01},
        "simplify": {"simplify": 8},
        "units": {"units": "cm"},
        "box": box,
        "other box": box | {"bbox": (15.0, 17.0, 9.0, 13.0)},
        "distortion": {"distortion": (-0.05, 0.0, 0.0, 0.0)},
        "other distortion": {"distortion": (-0.05, 0.0, 0.0, 0.001)},
        "distorted box": box | {"distortion": (-0.05, 0.0, 0.0, 0.001)},
        "other mesh": {"mesh": str(root / "models" / "obj_000001.ply")},
        "name": {"name": "other"},
        "video": {"video": True},
        "mask_label": {"mask": write_labels(root / "labels.png"), "mask_label": 2},
        "image": {"image": str(root / SCENE / "rgb" / "000003.png")},
        "depth": {"depth": str(root / SCENE / "depth" / "000000.png")},
        "depth_scale": {"depth": str(root / SCENE / "depth" / "000000.png"), "depth_scale": 0.1},
    }
    for name, changed in changes.items():
        perturbations.change(name, photo(root, **(given | changed)))
    assert {field.name for field in fields(PhotoConfig)} == {name for changed in changes.values() for name in changed}
    labelled = Perturbations(photo(root, **(given | changes["mask_label"] | {"mask_label": 1})))
    labelled.change("mask_label", photo(root, **(given | changes["mask_label"])))
    report(labelled, "label of a mask", record_property)
    files: dict[str, Callable[[Path], None]] = {
        "image": inverted(f"{SCENE}/rgb/000000.png"),
        "mask": pixel(f"{SCENE}/mask_visib/000000_000000.png"),
        "mesh": text_of("models/box.obj", "v 20", "v 21"),
        "material": text_of("models/box.mtl", "Kd 1", "Kd 0.5"),
        "texture": pixel("models/skin.png"),
        "unused file": text_of("models/models_info.json", "diameter", "diameter "),
    }
    for name, edit in files.items():
        other = tmp_path / name
        shutil.copytree(root, other)
        edit(other)
        perturbations.change(name, photo(other, mesh=str(other / "models" / "box.obj")), thorough=True)
    report(perturbations, "photograph", record_property)


def write_labels(path: Path) -> str:
    """A mask that labels two objects."""
    values = np.zeros((48, 64), np.uint8)
    values[10:20, 10:25], values[25:40, 30:50] = 1, 2
    PIL.Image.fromarray(values).save(path)
    return str(path)


def write_obj(path: Path) -> Path:
    """A textured box with its material in a file of its own."""
    corners = [f"v {20 * (i & 1 or -1)} {30 * (i >> 1 & 1 or -1)} {10 * (i >> 2 & 1 or -1)}" for i in range(8)]
    uv = ["vt 0 0", "vt 1 0", "vt 0 1", "vt 1 1"]
    faces = [" ".join(["f", *(f"{v + 1}/{v % 4 + 1}" for v in face)]) for face in FACES]
    path.write_text("\n".join(["mtllib box.mtl", *corners, *uv, "usemtl skin", *faces, ""]))
    path.with_suffix(".mtl").write_text("newmtl skin\nKd 1 1 1\nmap_Kd skin.png\n")
    return path


def test_photograph_and_mask_of_one_file_name_are_both_in_the_key(tmp_path: Path):
    scene = write_tiny_bop(tmp_path / "bop") / SCENE
    image, mask = tmp_path / "photos" / "shot.png", tmp_path / "masks" / "shot.png"
    for source, to in ((scene / "rgb/000000.png", image), (scene / "mask_visib/000000_000000.png", mask)):
        to.parent.mkdir()
        shutil.copy(source, to)
    run = photo(tmp_path / "bop", image=str(image), mask=str(mask))
    with track_files():
        before = run.graph()[0].detections.ref.key
    pixel("shot.png")(image.parent)
    with track_files():
        assert run.graph()[0].detections.ref.key != before


def test_rule_for_more_than_8_bits_is_in_the_key_of_photographs_alone(tmp_path: Path):
    PIL.Image.fromarray(np.full((30, 40), 4095, np.uint16)).save(tmp_path / "deep.png")
    assert image_digest(tmp_path / "deep.png") != file_digest(tmp_path / "deep.png")
    assert image_digest(tmp_path / "deep.png", photograph=False) == file_digest(tmp_path / "deep.png")


@pytest.mark.parametrize("orientation", [2, 3, 6, 8])
def test_exif_orientation_is_in_the_key_where_a_photograph_has_one(tmp_path: Path, orientation: int):
    picture, exif = PIL.Image.new("RGB", (40, 30)), PIL.Image.Exif()
    picture.save(tmp_path / "plain.jpg")
    exif[0x0112] = orientation
    picture.save(tmp_path / "turned.jpg", exif=exif)
    exif[0x0112] = 1
    picture.save(tmp_path / "upright.jpg", exif=exif)
    assert image_digest(tmp_path / "plain.jpg") == file_digest(tmp_path / "plain.jpg")
    assert image_digest(tmp_path / "upright.jpg") == file_digest(tmp_path / "upright.jpg")
    assert image_digest(tmp_path / "turned.jpg") != file_digest(tmp_path / "turned.jpg")


# --- weights ----------------------------------------------------------------------------------------------------------

ADDED = {  # what a library may read from a folder if it is there
    "added_tokens.json": {"ab</w>": 49407},
    "special_tokens_map.json": {"unk_token": "a</w>"},
    "generation_config.json": {"temperature": 0.5},
    "preprocessor_config.json": {"size": 17},
    "README.md": {},
}
EDITS: dict[str, Callable[[Any], Any]] = {  # fields of configs whose change leaves the weights fitting
    "layer_norm_eps": lambda v: 1e-3,
    "hidden_act": lambda v: "relu",
    "scaling_factor": lambda v: 2 * v,
    "norm_eps": lambda v: 1e-2,
    "beta_end": lambda v: 2 * v,
    "pad_token": lambda v: "b</w>",
    "bos_token": lambda v: "a</w>",
}


def weight_changes(folder: Path) -> Iterator[tuple[str, Callable[[Path], None]]]:
    """Every file of a folder changed."""
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        name = path.relative_to(folder).as_posix()
        if path.suffix == ".safetensors":
            yield name, lambda root, name=name: change_tensor(root / name)
        elif path.name == "vocab.json":
            yield name, lambda root, name=name: edit_json(root / name, swap_letters)
        elif path.suffix == ".json":
            for field in EDITS.keys() & json.loads(path.read_text()).keys():
                yield f"{name} {field}", field_of(name, field, value=EDITS[field])
        else:
            yield name, lambda root, name=name: (root / name).write_text("#version: 0.2\na b</w>\n")


def added_files(folder: Path) -> Iterator[tuple[str, list[str]]]:
    """Each folder that has files, with the paths of files that are not there."""
    for place in sorted({path.parent for path in folder.rglob("*") if path.is_file()}):
        name = place.relative_to(folder)
        yield name.as_posix(), [(name / added).as_posix() for added in ADDED]


def add_files(names: Sequence[str]) -> Callable[[Path], None]:
    def edit(root: Path) -> None:
        for name in names:
            (root / name).write_text(json.dumps(ADDED[Path(name).name]))

    return edit


def change_tensor(path: Path) -> None:
    tensors = load_file(path)
    name = max(tensors, key=lambda name: tensors[name].numel())
    tensors[name] = tensors[name] + 0.5
    save_file(tensors, path, metadata={"format": "pt"})


def swap_letters(vocabulary: dict[str, int]) -> None:
    vocabulary["a</w>"], vocabulary["b</w>"] = vocabulary["b</w>"], vocabulary["a</w>"]


@pytest.mark.parametrize("name", ["vit", "dinov2", pytest.param("sd", marks=pytest.mark.slow), "sam"])
def test_every_file_of_weights_is_in_a_key(name: str, tiny: Path, weights: Path, tmp_path: Path, record_property):
    def run(folder: Path) -> TinyRun:
        weights_at = {"weights": str(folder)}
        if name == "sam":
            sam = replace(stages_with("detect/cnos", tiny, weights).detect.proposals, **weights_at)
            hog = {"describe": variant("extract/hog"), "describe_layer": 2}
            return bop(tiny, replace(BASE, detect=variant("detect/cnos", proposals=sam, **hog)))
        extract = {
            "vit": lambda: variant("extract/dino", input_size=64, facet="token", norm_last=True, **weights_at),
            "dinov2": lambda: variant("extract/dinov2", input_size=56, **weights_at),
            "sd": lambda: variant("extract/stable_diffusion", input_size=64, prompt="ab", **weights_at),
        }[name]()
        return bop(tiny, replace(BASE, extract=extract), select=Select(objects=(1,)))

    perturbations = Perturbations(run(weights / name))

    def check(change: str, edit: Callable[[Path], None]) -> bool:
        """Whether the change gives another key; the bytes are compared otherwise."""
        folder = shutil.copytree(weights / name, tmp_path / "changed")
        edit(folder)
        known = perturbations.by_key
        try:
            perturbations.change(f"{name}: {change}", run(folder))
        except BadInput:  # a broken tokenizer gives no tokens, so there is no key
            assert "tokenizer" in change
        shutil.rmtree(folder)
        return perturbations.by_key > known

    for change, edit in weight_changes(weights / name):
        check(change, edit)
    for place, names in added_files(weights / name):
        if check(f"all new files in {place}", add_files(names)):  # each alone, so that none hides behind another
            for added in names:
                check(f"new {added}", add_files([added]))
    report(perturbations, f"weights of {name}", record_property)


def report(perturbations: Perturbations, name: str, record_property) -> None:
    total = perturbations.by_key + perturbations.by_bytes
    text = f"{name}: {total} inputs changed, {perturbations.by_key} change a key, {perturbations.by_bytes} no byte"
    record_property("summary", text)
    assert not perturbations.wrong, "\n".join(perturbations.wrong)
