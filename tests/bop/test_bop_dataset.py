import json
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image
from tiny_bop import HALF_MM, POSES, SIZE_HW, K, edit_json, rectangle, write_box_ply, write_json, write_tiny_bop

from pipeline.bop.dataset import Dataset, DatasetConfig, open_dataset
from pipeline.bop.scene import check_K
from pipeline.errors import BadInput
from pipeline.functional.camera import mask_bbox
from pipeline.items.views import Target
from pipeline.spec import build

CONF = Path(__file__).parents[2] / "conf"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_tiny_bop(tmp_path / "tiny")


@pytest.fixture
def scene(root: Path) -> Path:
    return root / "test" / "000007"


def open_tiny(root: Path, **options: object) -> Dataset:
    return open_dataset(root, name="tiny", **options)


def message(call: object, *args: object, **options: object) -> str:
    with pytest.raises(BadInput) as raised:
        call(*args, **options)
    text = str(raised.value)
    assert "\n" not in text
    return text


def test_result_does_not_depend_on_the_datasets_location(root: Path, tmp_path: Path):
    here = open_tiny(root)
    moved = root.rename(tmp_path / "elsewhere")
    there = open_tiny(moved)
    assert here.targets == there.targets
    assert there.object_model(1).mesh.digest == open_tiny(moved).object_model(1).mesh.digest


def test_order_of_the_targets_file_does_not_matter(root: Path):
    before = open_tiny(root).targets
    edit_json(root / "test_targets_bop19.json", lambda targets: targets.reverse())
    assert open_tiny(root).targets == before


def test_tiny_dataset_reads_as_it_was_written(root: Path):
    dataset = open_tiny(root)
    assert dataset.targets == (Target(7, 0, 1, 2), Target(7, 0, 2, 1), Target(7, 3, 2, 1))
    assert dataset.images == ((7, 0), (7, 3))
    assert dataset.object_ids == (1, 2)
    image = dataset.image(7, 0)
    np.testing.assert_array_equal(image.rgb, np.random.default_rng(0).integers(0, 256, (*SIZE_HW, 3), dtype=np.uint8))
    np.testing.assert_array_equal(image.K, np.reshape(K, (3, 3)))
    truth = dataset.ground_truth(7, 0)
    assert [gt.obj_id for gt in truth] == [1, 1, 2]
    np.testing.assert_array_equal(truth[1].T_cam_obj[:3, 3], POSES[0][1][1])
    assert truth[0].visib_fract == 0.5
    assert dataset.mask(7, 0, 2).sum() == dataset.mask(7, 0, 2, visible=False).sum() > 0
    assert dataset.object_model(1).diameter_mm == 2 * np.linalg.norm(HALF_MM[1])


def test_depth_is_scaled_to_millimetres(root: Path):
    np.testing.assert_array_equal(open_tiny(root).depth_mm(7, 0), np.full(SIZE_HW, 400.0, np.float32))


def test_annotated_box_spans_the_edges_of_the_mask(root: Path):
    dataset = open_tiny(root)
    for gt in dataset.ground_truth(7, 0):
        assert gt.bbox_visib_xyxy == mask_bbox(dataset.mask(7, 0, gt.gt_id))
    x0, y0, x1, y1 = rectangle(*POSES[0][0])
    assert dataset.ground_truth(7, 0)[0].bbox_obj_xyxy == (x0 - 0.5, y0 - 0.5, x1 + 0.5, y1 + 0.5)


def test_grey_images_have_three_equal_channels_and_8_bits(root: Path, scene: Path):
    ramp = np.arange(SIZE_HW[0] * SIZE_HW[1], dtype=np.uint16).reshape(SIZE_HW) * 21
    (scene / "gray").mkdir()
    for im_id, values, name in ((0, ramp, "000000.tif"), (3, (ramp / 257).astype(np.uint8), "000003.png")):
        (scene / "rgb" / f"{im_id:06d}.png").unlink()
        Image.fromarray(values).save(scene / "gray" / name)
    for im_id in (0, 3):
        rgb = open_tiny(root).image(7, im_id).rgb
        assert rgb.dtype == np.uint8
        assert (rgb == rgb[..., :1]).all()
        assert np.abs(rgb[..., 0] - ramp / 257).max() <= 1  # rounding of 16 to 8 bit


def test_without_a_targets_file_every_annotated_instance_is_a_target(root: Path):
    asked = open_tiny(root).targets
    (root / "test_targets_bop19.json").unlink()
    assert open_tiny(root).targets == asked
    assert open_tiny(root, targets=None).targets == asked


def test_opening_a_dataset_reads_no_pixels(root: Path, scene: Path):
    path = scene / "rgb" / "000000.png"
    path.write_bytes(path.read_bytes()[:200])  # complete header, no pixels
    dataset = open_tiny(root)
    assert "broken image" in message(dataset.image, 7, 0)
    assert str(path) in message(dataset.image, 7, 0)


def test_diameter_comes_from_the_mesh_without_models_info(root: Path):
    (root / "models" / "models_info.json").unlink()
    # float32 in the ply is exact for these lengths
    assert open_tiny(root).object_model(2).diameter_mm == pytest.approx(2 * np.linalg.norm(HALF_MM[2]), rel=1e-9)


def test_models_folder_is_chosen_by_argument(root: Path):
    (root / "models").rename(root / "models_cad")
    text = message(open_tiny, root)
    assert str(root / "models") in text
    assert "models_cad" in text
    assert open_tiny(root, models="models_cad").object_model(1).obj_id == 1


def test_camera_of_a_crop_is_accepted():
    K_crop = np.array([[572.4, 0, 325.3 - 500], [0, 573.6, 242.0 - 400], [0, 0, 1]])
    check_K(K_crop, (120, 180), "crop")


@pytest.mark.parametrize(
    ("file", "edit", "parts"),
    [
        (
            "scene_camera.json",
            lambda c: c.update({"3": {"cam_model": {"projection_model_type": "CAMERA_MODEL_FISHEYE624"}}}),
            ["image 3", "cam_model", "no cam_K", "undistort"],
        ),
        ("scene_camera.json", lambda c: c.pop("3"), ["scene 7", "image 3", "no entry", "cam_K"]),
        ("scene_camera.json", lambda c: c["3"].update(cam_K=K[:8]), ["image 3", "cam_K", "8 elements|8", "9 numbers"]),
        (
            "scene_camera.json",
            lambda c: c["0"]["cam_K"].__setitem__(2, float("nan")),
            ["image 0", "cam_K", "nan at position 2"],
        ),
        ("scene_camera.json", lambda c: c["0"]["cam_K"].__setitem__(0, "80"), ["image 0", "cam_K", "9 numbers"]),
        ("scene_camera.json", lambda c: c["0"]["cam_K"].__setitem__(0, -80.0), ["image 0", "cam_K", "fx -80"]),
        (
            "scene_camera.json",
            lambda c: c["0"]["cam_K"].__setitem__(2, 640.0),
            ["image 0", "cam_K", "cx 640", "64 x 48"],
        ),
        ("scene_camera.json", lambda c: c["0"]["cam_K"].__setitem__(8, 2.0), ["image 0", "cam_K"]),
        ("scene_camera.json", lambda c: c["0"]["cam_K"].__setitem__(1, 3.0), ["image 0", "cam_K", "skew of 3"]),
        (
            "scene_camera.json",
            lambda c: c["0"].update(cam_K=[2 * v for v in K[:8]] + [1.0]),
            ["image 0", "cam_K", "3 of 3 annotated objects", "64 x 48"],
        ),
        ("scene_camera.json", lambda c: c["0"].update(depth_scale=0), ["image 0", "depth_scale", "0"]),
        ("scene_gt.json", lambda c: c["3"][0].update(cam_R_m2c=[2.0] * 9), ["image 3", "instance 0", "cam_R_m2c"]),
        (
            "scene_gt.json",
            lambda c: c["3"][0].update(cam_R_m2c=[1.0, 0, 0, 0, 1, 0, 0, 0, -1]),
            ["image 3", "instance 0", "cam_R_m2c", "reflection"],
        ),
        ("scene_gt.json", lambda c: c["3"][0]["cam_t_m2c"].__setitem__(2, -5.0), ["image 3", "cam_t_m2c", "z = -5"]),
        (
            "scene_gt.json",
            lambda c: c["3"][0]["cam_t_m2c"].__setitem__(0, float("inf")),
            ["image 3", "cam_t_m2c", "inf"],
        ),
        ("scene_gt.json", lambda c: c["3"][0].pop("obj_id"), ["image 3", "instance 0", "obj_id"]),
        ("scene_gt.json", lambda c: c.pop("3"), ["image 3", "no entry"]),
        ("scene_gt_info.json", lambda c: c["0"].pop(), ["image 0", "2 entries", "3 entries"]),
        ("scene_gt_info.json", lambda c: c["3"][0].update(visib_fract=None), ["image 3", "visib_fract", "null"]),
    ],
)
def test_fault_in_a_scene_is_reported_with_its_location(root: Path, scene: Path, file: str, edit, parts: list[str]):
    edit_json(scene / file, edit)
    text = message(open_tiny, root)
    assert str(scene / file) in text
    for part in parts:
        assert re.search(part, text), f"{part!r} in {text!r}"


@pytest.mark.parametrize(
    ("edit", "parts"),
    [
        (lambda t: t.append({"scene_id": 7, "im_id": 9, "obj_id": 1, "inst_count": 1}), ["image 9", "no entry"]),
        (lambda t: t.append({"scene_id": 8, "im_id": 0, "obj_id": 1, "inst_count": 1}), ["scene 8", "no such folder"]),
        (lambda t: t.append({"scene_id": 7, "im_id": 0, "obj_id": 5, "inst_count": 1}), ["obj_000005.ply", "object 5"]),
        (lambda t: t[0].pop("obj_id"), ["target 0", "obj_id"]),
        (lambda t: t[1].update(im_id="0"), ["target 1", "im_id", "integer"]),
        (lambda t: t[1].update(inst_count=0), ["target 1", "inst_count"]),
        (lambda t: t.append(t[0]), ["image 0", "object 1", "twice"]),
        (lambda t: t.clear(), ["list of targets"]),
    ],
)
def test_fault_in_the_targets_is_reported_with_its_location(root: Path, edit, parts: list[str]):
    edit_json(root / "test_targets_bop19.json", edit)
    text = message(open_tiny, root)
    for part in parts:
        assert part in text


def test_missing_image_of_a_target_is_reported(root: Path, scene: Path):
    (scene / "rgb" / "000003.png").unlink()
    text = message(open_tiny, root)
    assert "scene 7, image 3" in text
    assert "rgb/000003.png" in text


def test_invalid_json_is_reported_with_its_line(root: Path, scene: Path):
    (scene / "scene_camera.json").write_text('{"0": {\n"cam_K": [1,,2]}}')
    text = message(open_tiny, root)
    assert str(scene / "scene_camera.json") in text
    assert "line 2" in text


@pytest.mark.parametrize(("field", "value"), [("root", "absent"), ("split", "train"), ("models", "meshes")])
def test_missing_folder_is_reported(root: Path, field: str, value: str):
    config = {"name": "tiny", "root": str(root), "split": "test", "models": "models"} | {field: value}
    text = message(DatasetConfig(**config).open)
    assert value in text
    assert "no such folder" in text


def test_object_missing_in_models_info_is_reported(root: Path):
    edit_json(root / "models" / "models_info.json", lambda info: info.pop("2"))
    text = message(open_tiny, root)
    assert "models_info.json, object 2" in text
    assert "entries for 1" in text


def test_mesh_in_metres_is_detected_with_and_without_models_info(root: Path):
    write_box_ply(root / "models" / "obj_000001.ply", tuple(h / 1000 for h in HALF_MM[1]))
    text = message(open_tiny(root).object_model, 1)
    assert "obj_000001.ply" in text
    assert "metres" in text
    (root / "models" / "models_info.json").unlink()
    text = message(open_tiny(root).object_model, 1)
    assert "obj_000001.ply" in text
    assert "metres" in text


def test_translations_in_metres_are_detected(root: Path, scene: Path):
    edit_json(
        scene / "scene_gt.json",
        lambda c: [g.update(cam_t_m2c=[v / 1000 for v in g["cam_t_m2c"]]) for i in c for g in c[i]],
    )
    (scene / "scene_gt_info.json").unlink()
    assert "cam_t_m2c looks like metres" in message(open_tiny(root).object_model, 2)


@pytest.mark.parametrize(
    ("edit", "parts"),
    [
        (lambda i: i["1"].pop("diameter"), ["object 1", "diameter"]),
        (lambda i: i["1"].update(diameter=float("nan")), ["object 1", "diameter", "NaN"]),
        (lambda i: i["1"].update(symmetries_discrete=[[1.0] * 16]), ["object 1", "symmetries_discrete 0"]),
        (
            lambda i: i["1"].update(symmetries_discrete=[[1.0] * 12]),
            ["object 1", "symmetries_discrete 0", "16 numbers"],
        ),
        (
            lambda i: i["1"].update(symmetries_continuous=[{"axis": [0, 0, 0], "offset": [0, 0, 0]}]),
            ["object 1", "axis"],
        ),
        (lambda i: i["1"].update(symmetries_continuous=[{"axis": [0, 0, 1]}]), ["object 1", "offset"]),
    ],
)
def test_fault_in_models_info_is_reported_with_its_location(root: Path, edit, parts: list[str]):
    edit_json(root / "models" / "models_info.json", edit)
    text = message(open_tiny, root)
    for part in ["models_info.json", *parts]:
        assert part in text


def test_number_of_symmetries_equals_bop_toolkits(bop_reference: Path, root: Path):
    for path in (bop_reference / "models").iterdir():
        (root / "models" / path.name).write_bytes(path.read_bytes())
    names = ("scene_id", "im_id", "obj_id", "inst_count")
    write_json(root / "test_targets_bop19.json", [dict(zip(names, (7, 0, o, 1), strict=True)) for o in (1, 2, 3)])
    (root / "test" / "000007" / "scene_gt.json").unlink()
    dataset = open_tiny(root)
    counts = json.loads((bop_reference / "pose_errors.json").read_text())["symmetry_count"]
    for obj_id, count in counts.items():
        symmetries = dataset.object_model(int(obj_id)).symmetries
        assert len(symmetries) == count
        np.testing.assert_array_equal(symmetries[0], np.eye(4))


def test_lmo_images_can_be_read(bop_mini: Path):
    dataset = open_dataset(bop_mini / "lmo", name="lmo")
    assert len(dataset.targets) == 285
    assert len(dataset.images) == 40
    assert dataset.object_ids == (1, 5, 6, 8, 9, 10, 11, 12)
    scene_id, im_id = dataset.images[0]
    assert dataset.image(scene_id, im_id).rgb.shape == (480, 640, 3)
    assert [len(dataset.object_model(o).symmetries) for o in dataset.object_ids] == [1, 1, 1, 1, 1, 2, 2, 1]
    # the published rotation is kept, although it is only orthonormal to this tolerance
    R = dataset.ground_truth(scene_id, im_id)[0].T_cam_obj[:3, :3]
    assert 1e-9 < np.abs(R @ R.T - np.eye(3)).max() < 2e-2


def test_ycbv_images_can_be_read(bop_mini: Path):
    dataset = open_dataset(bop_mini / "ycbv", name="ycbv")
    assert len(dataset.targets) == 6
    assert dataset.depth_mm(100, 1).max() > 500
    for scene_id, im_id in dataset.images:
        for gt in dataset.ground_truth(scene_id, im_id):
            assert gt.bbox_visib_xyxy == mask_bbox(dataset.mask(scene_id, im_id, gt.gt_id))
    assert dataset.object_model(21).mesh.texture is not None


@pytest.mark.parametrize("resize", [0.5, 2.0])
def test_camera_of_another_image_size_is_detected_on_real_images(bop_mini: Path, tmp_path: Path, resize: float):
    for dataset in ("lmo", "ycbv"):
        bop = tmp_path / f"{dataset}{resize}"
        scene = next((bop_mini / dataset / "test").iterdir())
        copy = bop / "test" / scene.name
        (copy / "rgb").mkdir(parents=True)
        for path in [*scene.glob("*.json")]:
            (copy / path.name).write_bytes(path.read_bytes())
        (bop / "models").symlink_to(bop_mini / dataset / "models")
        edit_json(
            copy / "scene_camera.json", lambda c: [v.update(cam_K=scale_K(v["cam_K"], resize)) for v in c.values()]
        )
        (copy / "rgb").rmdir()
        (copy / "rgb").symlink_to(scene / "rgb")
        (bop / "test_targets_bop19.json").symlink_to(bop_mini / dataset / "test_targets_bop19.json")
        assert "cam_K" in message(open_dataset, bop, name=dataset)


def scale_K(K_list: list[float], factor: float) -> list[float]:
    return [v * factor for v in K_list[:8]] + [1.0]


@pytest.mark.parametrize("name", ["lmo", "ycbv", "tless", "bop"])
def test_dataset_yaml_lists_every_field_and_can_be_instantiated(name: str):
    values = yaml.safe_load((CONF / "dataset" / f"{name}.yaml").read_text())["dataset"]
    assert values.pop("_target_") == "pipeline.bop.dataset.DatasetConfig"
    config = build(DatasetConfig, values, where="dataset")
    assert set(values) == {"name", "root", "split", "models", "targets", "simplify"} | (
        {"sensor"} if name == "bop" else set()
    )
    assert config.name == (name if name != "bop" else "???")


def test_unknown_dataset_field_is_reported_in_one_line():
    assert "dataset.modells" in message(
        build, DatasetConfig, {"name": "a", "root": "b", "modells": "c"}, where="dataset"
    )
