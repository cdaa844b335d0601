"""Datasets in other layouts than BOP19's: read, or refused with what was found instead."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from tiny_bop import HALF_MM, edit_json, write_json, write_tiny_bop

from pipeline.bop.dataset import Dataset, open_dataset
from pipeline.errors import BadInput
from pipeline.items.views import Target
from pipeline.stages.detect.gt_bbox import GtBbox
from pipeline.stages.detect.gt_mask import GtMask


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_tiny_bop(tmp_path / "tiny")


def open_tiny(root: Path, **options: Any) -> Dataset:
    return open_dataset(root, name="tiny", **options)


def message(call: Callable[..., object], *args: object, **options: object) -> str:
    with pytest.raises(BadInput) as raised:
        call(*args, **options)
    assert "\n" not in str(raised.value)
    return str(raised.value)


@pytest.mark.parametrize("images", [[(7, 0)], [(7, 3)], [(7, 3), (7, 0)]])
def test_targets_without_objects_are_the_annotated_instances(root: Path, images: list[tuple[int, int]]):
    write_json(root / "test_targets_bop24.json", [{"scene_id": s, "im_id": i} for s, i in images])
    expected = tuple(target for target in open_tiny(root).targets if (7, target.im_id) in images)
    dataset = open_tiny(root, targets="test_targets_bop24.json")
    assert dataset.targets == expected
    assert "BOP24" in dataset.warnings[0]


@pytest.mark.parametrize("targets", ["test_targets_bop24.json", "test_targets_bop19.json", None])
def test_scenes_without_annotations_name_what_is_missing(root: Path, targets: str | None):
    (root / "test" / "000007" / "scene_gt.json").unlink()
    write_json(root / "test_targets_bop24.json", [{"scene_id": 7, "im_id": 0}])
    if targets == "test_targets_bop19.json":
        dataset = open_tiny(root)
        for detect in (GtMask(), GtBbox()):
            assert "detect=json or cnos" in message(detect.sources, dataset, dataset.targets)
    else:
        text = message(open_tiny, root, targets=targets)
        assert "annotations" in text
        assert "obj_id, inst_count" in text


def test_targets_that_mix_formats_are_refused(root: Path):
    edit_json(root / "test_targets_bop19.json", lambda targets: targets[1].pop("obj_id"))
    assert "target 1, field obj_id" in message(open_tiny, root)


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".stl"])
def test_models_in_other_formats_are_read(root: Path, suffix: str):
    for obj_id, half in HALF_MM.items():
        (root / "models" / f"obj_{obj_id:06d}.ply").unlink()
        trimesh.creation.box(extents=2 * np.array(half)).export(root / "models" / f"obj_{obj_id:06d}{suffix}")
    model = open_tiny(root).object_model(2)
    assert model.diameter_mm == pytest.approx(2 * np.linalg.norm(HALF_MM[2]))
    assert open_tiny(root).model_warning(2, model.facts) == ""


def name_after_sensors(root: Path, sensors: list[str], *, modality: str = "rgb") -> Path:
    """The tiny scene as BOP-Industrial's datasets have it; the sensors after the first see object 2 alone."""
    scene = root / "test" / "000007"
    for number, sensor in enumerate(sensors):
        for folder, name in (("rgb", modality), ("depth", "depth"), ("mask", "mask"), ("mask_visib", "mask_visib")):
            shutil.copytree(scene / folder, scene / f"{name}_{sensor}")
        for name in ("scene_camera", "scene_gt", "scene_gt_info"):
            content = json.loads((scene / f"{name}.json").read_text())
            if number and name != "scene_camera":
                content["0"] = content["0"][2:]
            write_json(scene / f"{name}_{sensor}.json", content)
        for visible in ("mask", "mask_visib") if number else ():
            (scene / f"{visible}_{sensor}" / "000000_000002.png").rename(
                scene / f"{visible}_{sensor}" / "000000_000000.png"
            )
    for path in [p for p in scene.iterdir() if p.stem in ("rgb", "depth", "mask", "mask_visib")]:
        shutil.rmtree(path)
    for name in ("scene_camera", "scene_gt", "scene_gt_info"):
        (scene / f"{name}.json").unlink()
    return scene


@pytest.mark.parametrize(
    ("sensors", "modality"), [(["cam1"], "rgb"), (["cam1", "cam2", "photoneo"], "rgb"), (["3dlong", "cam0"], "gray")]
)
def test_files_of_each_sensor_are_read(root: Path, sensors: list[str], modality: str):
    before = open_tiny(root)
    scene = name_after_sensors(root, sensors, modality=modality)
    targets = before.targets
    for number, sensor in enumerate(sensors):
        dataset = open_tiny(root, sensor=sensor, targets=None)
        assert dataset.image_path(7, 0) == scene / f"{modality}_{sensor}" / "000000.png"
        np.testing.assert_array_equal(dataset.image(7, 0).rgb, open_tiny(root, sensor=sensors[0]).image(7, 0).rgb)
        assert dataset.depth_mm(7, 3).max() == 400
        assert dataset.targets == (targets if not number else tuple(t for t in targets if t.obj_id == 2))
        for detect in (GtMask(), GtMask(visible=False), GtBbox()):
            assert all(path.is_file() for path in detect.sources(dataset, dataset.targets))
            assert all(d.defect is None for d in detect(dataset, dataset.targets))


@pytest.mark.parametrize("sensors", [["cam1"], ["cam1", "cam2", "cam3"], ["photoneo"]])
def test_without_the_choice_of_a_sensor_those_there_are_listed(root: Path, sensors: list[str]):
    name_after_sensors(root, sensors)
    for chosen in (None, "cam9"):
        text = message(open_tiny, root, sensor=chosen)
        assert f"sensors {', '.join(sensors)} and no scene_camera{'_cam9' if chosen else ''}.json" in text
        assert f"dataset.sensor={sensors[0]}" in text


def test_a_sensor_of_a_dataset_without_any_is_refused(root: Path):
    assert "needs dataset.sensor=null" in message(open_tiny, root, sensor="cam1")


@pytest.mark.parametrize("sensor", ["../cam1", "", "a/b", "cam 1", "." * 3, "x" * 99])
def test_a_sensor_that_is_no_part_of_a_file_name_is_refused(root: Path, sensor: str):
    assert "dataset.sensor: found" in message(open_tiny, root, sensor=sensor)


def test_files_without_a_suffix_are_read_beside_those_of_sensors(root: Path):
    scene = root / "test" / "000007"
    shutil.copy(scene / "scene_camera.json", scene / "scene_camera_cam1.json")
    assert open_tiny(root).image_path(7, 0) == scene / "rgb" / "000000.png"


@pytest.mark.parametrize("sensor", ["cam1", "photoneo"])
def test_width_of_a_sensor_without_images_is_that_of_its_camera_file(root: Path, sensor: str):
    scene = name_after_sensors(root, [sensor])
    write_json(root / "camera_a.json", {"width": 1000})
    write_json(root / f"camera_{sensor}.json", {"width": 320})
    shutil.rmtree(scene / f"rgb_{sensor}")
    shutil.rmtree(scene / f"depth_{sensor}")
    assert open_tiny(root, sensor=sensor, photographs=False).image_width(7, 0) == 320


@pytest.mark.parametrize("detect", [GtMask(), GtMask(visible=False)])
def test_scenes_without_any_mask_are_refused(root: Path, detect: GtMask):
    scene = root / "test" / "000007"
    folder = "mask_visib" if detect.visible else "mask"
    (scene / folder / "000000_000000.png").unlink()
    dataset = open_tiny(root)
    assert len(detect(dataset, dataset.targets)) == len(detect.sources(dataset, dataset.targets)) - 4 + 1
    shutil.rmtree(scene / folder)
    text = message(detect.sources, dataset, dataset.targets)
    assert f"{folder}: found none of the 4 masks" in text
    assert "calc_gt_masks.py" in text


def archive(root: Path) -> Path:
    return Path(shutil.make_archive(str(root), "zip", root))


@pytest.mark.parametrize(
    ("place", "parts"),
    [
        (archive, ["an archive in place of its folder", "unpack"]),
        (lambda root: root / "test_targets_bop19.json", ["a file in place of a folder"]),
        (lambda root: root.parent, ["dataset.root=", "/tiny,"]),
        (lambda root: root / "test", ["dataset.root=", "/tiny,"]),
        (lambda root: root / "test" / "000007", ["dataset.root=", "/tiny,"]),
        (lambda root: root.parent / "tinny", ["no such folder", "there: tiny"]),
    ],
)
def test_root_at_another_place_is_named(root: Path, place: Callable[[Path], Path], parts: list[str]):
    text = message(open_tiny, place(root))
    for part in parts:
        assert part in text


@pytest.mark.parametrize(("folder", "what"), [("test", "a split"), ("models", "object models")])
def test_folder_one_level_too_deep_or_still_packed_is_named(root: Path, folder: str, what: str):
    (root / folder).rename(root / "moved")
    (root / folder).mkdir()
    (root / "moved").rename(root / folder / folder)
    text = message(open_tiny, root)
    assert f"{root / folder}: found a folder within: {folder}, needs {what}" in text
    shutil.make_archive(str(root / f"tiny_{folder}"), "zip", root / folder)
    shutil.rmtree(root / folder)
    assert f"tiny_{folder}.zip, to be unpacked" in message(open_tiny, root)


@pytest.mark.parametrize("factor", [1000, 100, 25.4, 10])
@pytest.mark.parametrize("of_mesh", [True, False])
def test_diameters_in_other_units_are_refused(root: Path, factor: float, of_mesh: bool):
    scale = factor if of_mesh else 1 / factor
    edit_json(root / "models" / "models_info.json", lambda i: i["1"].update(diameter=i["1"]["diameter"] * scale))
    text = message(open_tiny(root).object_model, 1)
    assert "looks like" in text
    assert ("models_info.json looks like" in text) != of_mesh


@pytest.mark.parametrize("factor", [0.5, 0.8, 1.3, 3.0])
def test_other_diameters_are_a_warning_and_kept(root: Path, factor: float):
    stated = 2 * float(np.linalg.norm(HALF_MM[1])) * factor
    edit_json(root / "models" / "models_info.json", lambda i: i["1"].update(diameter=stated))
    dataset = open_tiny(root)
    model = dataset.object_model(1)
    assert model.diameter_mm == stated
    assert f"models_info.json says {stated:.4g}" in dataset.model_warning(1, model.facts)


@pytest.mark.parametrize("extents", [(60, 60, 60), (100, 100, 40), (200, 150, 150)])
def test_diagonal_of_the_bounding_box_as_diameter_is_recognised(root: Path, extents: tuple[int, int, int]):
    octahedron = trimesh.Trimesh(
        np.concatenate([np.diag(extents), -np.diag(extents)]) / 2,
        [(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2), (1, 0, 5), (3, 1, 5), (4, 3, 5), (0, 4, 5)],
    )
    octahedron.export(root / "models" / "obj_000001.ply")
    diagonal = float(np.linalg.norm(extents))
    edit_json(root / "models" / "models_info.json", lambda i: i["1"].update(diameter=diagonal))
    dataset = open_tiny(root)
    assert "diagonal of its bounding box" in dataset.model_warning(1, dataset.object_model(1).facts)


@pytest.mark.parametrize("obj_id", [1000008, 999999, 12345678])
def test_object_ids_of_seven_digits_are_read(root: Path, obj_id: int):
    models, scene = root / "models", root / "test" / "000007"
    (models / "obj_000002.ply").rename(models / f"obj_{obj_id:06d}.ply")
    edit_json(models / "models_info.json", lambda i: i.update({str(obj_id): i.pop("2")}))
    edit_json(root / "test_targets_bop19.json", lambda t: [x.update(obj_id=obj_id) for x in t if x["obj_id"] == 2])
    edit_json(scene / "scene_gt.json", lambda c: [g.update(obj_id=obj_id) for i in c for g in c[i] if g["obj_id"] == 2])
    dataset = open_tiny(root)
    assert Target(7, 3, obj_id, 1) in dataset.targets
    assert dataset.object_model(obj_id).obj_id == obj_id
    assert [d.obj_id for d in GtMask()(dataset, [Target(7, 3, obj_id)])] == [obj_id]
