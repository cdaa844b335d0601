"""dataset=photo: several photographs and instances, and the places that K may come from."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest

from pipeline.bop.camera_files import numbers_in, read_camera
from pipeline.bop.photo import PhotoConfig
from pipeline.errors import BadInput
from pipeline.io.meshes import write_ply
from pipeline.synthetic.objects import make_object

K = (300.0, 300.0, 160.0, 120.0)
MATRIX = [300.0, 0, 160, 0, 300, 120, 0, 0, 1]


@pytest.fixture
def folder(tmp_path) -> Path:
    """a.png, b.png and b_2.png with masks in masks/: one of a.png, one of b_2.png, two of b.png."""
    write_ply(tmp_path / "mug.ply", make_object(3))
    (tmp_path / "masks").mkdir()
    for name in ("a", "b", "b_2"):
        PIL.Image.new("RGB", (320, 240), (90, 90, 90)).save(tmp_path / f"{name}.png")
    for left, name in enumerate(("a", "b_left", "b_right", "b_2")):
        mask = np.zeros((240, 320), np.uint8)
        mask[50:90, 20 * left : 20 * left + 30] = 255
        PIL.Image.fromarray(mask).save(tmp_path / "masks" / f"{name}.png")
    return tmp_path


def config(folder: Path, **given) -> PhotoConfig:
    return PhotoConfig(**{"mesh": str(folder / "mug.ply"), "image": str(folder / "*.png"), "K": K} | given)


def test_every_photograph_gets_the_masks_whose_names_begin_with_its_own(folder):
    photo = config(folder, mask=str(folder / "masks" / "*.png")).open()
    assert [photo.image_name(0, n) for n in range(3)] == ["a.png", "b.png", "b_2.png"]
    assert [target.inst_count for target in photo.targets] == [1, 2, 1]
    left = [[d.bbox_xyxy[0] + 0.5 for d in photo.locate(target)] for target in photo.targets]
    assert left == [[0], [20, 40], [60]]


def test_labels_of_a_mask_are_instances(folder):
    labels = np.zeros((240, 320), np.uint8)
    labels[10:60, 10:60], labels[10:60, 100:160], labels[100:150, 10:60] = 1, 2, 3
    PIL.Image.fromarray(labels).save(folder / "labels.png")
    photo = config(folder, image=str(folder / "a.png"), mask=str(folder / "labels.png"), mask_label=(2, 3)).open()
    assert [d.bbox_xyxy[:2] for d in photo.locate(photo.targets[0])] == [(99.5, 9.5), (9.5, 99.5)]
    one = config(folder, image=str(folder / "a.png"), mask=str(folder / "labels.png"), mask_label=2).open()
    assert len(one.locate(one.targets[0])) == one.targets[0].inst_count == 1


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"image": "none/*.png"}, "dataset.image: found no file that matches none/*.png, needs at least one"),
        ({"bbox": (1, 2, 3, 4)}, "dataset.bbox: found one box for 3 photographs, needs dataset.mask, one for each"),
        ({"bbox": "5"}, "dataset.bbox: found 1 numbers, needs 4: [x,y,width,height]"),
        ({"K": 5}, "dataset.K: found 5, needs [fx,fy,cx,cy]"),
        ({"K": "camera"}, "dataset.K: found 'camera', needs [fx,fy,cx,cy]"),
        ({"K": "1 2 3"}, "dataset.K: found 3 numbers, needs [fx,fy,cx,cy]"),
        (
            {"K": "exif"},
            "a.png: found no FocalLengthIn35mmFilm in its EXIF data, needs one, or dataset.K=[fx,fy,cx,cy]",
        ),
    ],
)
def test_what_does_not_fit_is_refused_by_name(folder, given, message):
    with pytest.raises(BadInput) as raised:
        config(folder, **given).open()
    assert message in str(raised.value)


def test_photographs_of_two_sizes_and_a_missing_mask_are_named(folder):
    with pytest.raises(BadInput, match=r"dataset\.mask: found no mask of b\.png among 1, needs one named b\.png or b_"):
        config(folder, mask=str(folder / "masks" / "a.png")).open()
    PIL.Image.new("RGB", (100, 80)).save(folder / "c.png")
    with pytest.raises(BadInput, match=r"c\.png: found 100 x 80 pixels, needs those of a\.png, 320 x 240"):
        config(folder).open()


ROS = """image_width: 320
image_height: 240
camera_name: head
camera_matrix: {rows: 3, cols: 3, data: [300, 0, 160, 0, 300, 120, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.1, 0.01, 0.001, 0, 0]}
"""
MESSAGE = "width: 320\nheight: 240\nd: [0.0, 0, 0, 0, 0]\nk: [300.0, 0, 160, 0, 300, 120, 0, 0, 1]\n"


def test_cameras_of_ros_opencv_and_bop_are_read(folder):
    (folder / "ros.yaml").write_text(ROS)
    (folder / "message.yaml").write_text(MESSAGE)
    named = {"fx": 300, "fy": 300, "cx": 160, "cy": 120, "width": 320, "height": 240}
    (folder / "bop.json").write_text(json.dumps(named))
    (folder / "rows.json").write_text(json.dumps({"K": [MATRIX[:3], MATRIX[3:6], MATRIX[6:]]}))
    storage = cv2.FileStorage(str(folder / "opencv.yml"), cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", np.array(MATRIX).reshape(3, 3))
    storage.write("distortion_coefficients", np.array([[-0.1, 0.01, 0.001, 0, 0]]))
    storage.release()
    for name in ("ros.yaml", "message.yaml", "bop.json", "rows.json", "opencv.yml"):
        camera = read_camera(folder / name)
        assert camera.K.ravel().tolist() == MATRIX, name
        distorted = name in ("ros.yaml", "opencv.yml")
        assert camera.distortion == ((-0.1, 0.01, 0.001, 0, 0) if distorted else ()), name
        photo = config(folder, K=str(folder / name)).open()
        assert (photo.lens is not None) == distorted


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (ROS.replace("image_width: 320", "image_width: 640"), "found the camera of images of 640 x 240, needs that of"),
        (ROS.replace("plumb_bob", "equidistant"), "found distortion_model equidistant, needs plumb_bob"),
        ("camera: {f: 3}", "found fields camera, needs camera_matrix or K with 9 numbers, or fx, fy, cx, cy"),
        ("K: [1, 2]", "found 2 numbers, needs camera_matrix or K"),
        ("[1, 2", "found invalid syntax"),
        ("!!python/object/apply:os.system [ls]", "found invalid syntax"),
    ],
)
def test_a_camera_file_that_cannot_be_used_is_named(folder, text, message):
    (folder / "camera.yaml").write_text(text)
    with pytest.raises(BadInput) as raised:
        config(folder, K=str(folder / "camera.yaml")).open()
    assert str(raised.value).startswith(str(folder / "camera.yaml"))
    assert message in str(raised.value)


def test_the_exif_focal_length_is_a_guess_with_a_warning(folder):
    exif = PIL.Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 26
    PIL.Image.new("RGB", (400, 300)).save(folder / "phone.jpg", exif=exif)
    photo = config(folder, image=str(folder / "phone.jpg"), K="exif").open()
    assert photo.camera_matrix[0, 0] == pytest.approx(26 / np.hypot(36, 24) * 500)
    assert photo.camera_matrix[:2, 2].tolist() == [199.5, 149.5]
    assert "EXIF" in photo.warnings[0]


def test_numbers_in_words():
    assert numbers_in("600 600 320,240") == numbers_in("[600, 600, 320, 240]") == [600, 600, 320, 240]
    assert numbers_in("camera.yaml") is None


def test_units_of_a_mesh(folder):
    diameter = config(folder).open().object_model(1).diameter_mm
    mesh = make_object(3)
    write_ply(folder / "metres.ply", replace(mesh, vertices=mesh.vertices / 1000))
    for units, name, factor in (("cm", "mug", 10), ("inch", "mug", 25.4), ("auto", "mug", 1), ("auto", "metres", 1)):
        photo = config(folder, mesh=str(folder / f"{name}.ply"), units=units).open()
        model = photo.object_model(1)
        assert model.diameter_mm == pytest.approx(factor * diameter, rel=1e-4)
        assert photo.mesh_digest(1) == model.mesh.digest
        assert ("taken as metres" in photo.model_warning(1, model.facts)) == (name == "metres")
    metres = config(folder, mesh=str(folder / "metres.ply"), units="m").open()
    assert metres.object_model(1).diameter_mm == pytest.approx(diameter, rel=1e-4)
    assert metres.model_warning(1, metres.object_model(1).facts) == ""
    assert metres.object_model(1).facts == model.facts  # they share templates, which keep the facts
