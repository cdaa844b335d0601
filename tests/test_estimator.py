"""The Python API: the poses of the command line, and errors in one line."""

import json
import subprocess
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest
from command import run_dzop
from scipy.spatial.transform import Rotation

from pipeline import BadInput, PoseEstimator
from pipeline.functional.rigid import rigid
from pipeline.io.meshes import write_ply
from pipeline.stages.render.raycast import Raycast
from pipeline.synthetic.objects import make_object

K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
SIZE_HW = (240, 320)
SMALL = ("method=dzop_x", "extract=hog", "render.count=60", "render.size=128", "runtime.device=cpu")
POSES = {"mug": (3, [60, 20, 30], [20.0, 10, 500]), "box": (1, [100, 30, 20], [-60.0, -20, 600])}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """mug.ply and box.ply, shot.png of both, and a mask of each."""
    folder = tmp_path_factory.mktemp("own")
    photo = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (*SIZE_HW, 3), np.uint8), (0, 0), 3)
    for name, (index, angles, t) in POSES.items():
        mesh, R = make_object(index), Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
        rgb, depth_mm = Raycast().render(mesh, K, rigid(R, np.array(t))[None], SIZE_HW)
        mask = depth_mm[0] > 0
        photo[mask] = rgb[0][mask]
        write_ply(folder / f"{name}.ply", mesh)
        PIL.Image.fromarray(mask * np.uint8(255)).save(folder / f"{name}_mask.png")
    PIL.Image.fromarray(photo).save(folder / "shot.png")
    return folder


def read(path: Path) -> np.ndarray:
    return np.asarray(PIL.Image.open(path))


@pytest.fixture(scope="module")
def estimator(folder):
    meshes = {name: folder / f"{name}.ply" for name in POSES}
    with PoseEstimator.from_mesh(meshes, settings=SMALL, cache=folder / "cache") as estimator:
        yield estimator


def test_a_pose_is_that_of_the_command_line_to_the_last_digit(estimator, folder, tmp_path, capsys, monkeypatch):
    rgb = read(folder / "shot.png")
    found = {
        "mask": estimator(rgb, K, mask=read(folder / "mug_mask.png"), name="mug"),
        "bbox": estimator(rgb, (300, 300, 160, 120), bbox=[120, 70, 130, 110], name="mug"),
    }
    given = {"mask": f"dataset.mask={folder}/mug_mask.png", "bbox": "dataset.bbox=[120,70,130,110]"}
    for name, result in found.items():
        ran = run_dzop(
            capsys, monkeypatch, "dataset=photo", f"dataset.mesh={folder}/mug.ply", f"dataset.image={folder}/shot.png",
            "dataset.K=[300,300,160,120]", given[name], *SMALL, f"store.root={folder}/cache", f"out={tmp_path}/{name}",
            "overlays=false",
        )  # fmt: skip
        assert ran.status == 0, ran.err
        assert ran.counts()[0]["templates"] == (0, 60)  # those that the estimator made
        (answer,) = json.loads(next(tmp_path.glob(f"{name}/*/*/poses.json")).read_text())["answers"]
        assert np.array_equal(result.T_cam_obj, np.array(answer["T_cam_obj"]))
        assert (result.score, result.inliers) == (answer["score"], answer["inliers"])


def test_several_objects_and_instances_come_in_the_order_given(estimator, folder):
    rgb, masks = read(folder / "shot.png"), {name: read(folder / f"{name}_mask.png") > 0 for name in POSES}
    results = estimator.find(rgb, K, {"box": masks["box"], "mug": [masks["mug"], [120, 70, 130, 110]]})
    assert [result.name for result in results] == ["box", "mug", "mug"]
    (box, mug, boxed), alone = results, estimator(rgb, K, mask=masks["mug"], name="mug")
    assert np.array_equal(mug.T_cam_obj, alone.T_cam_obj)
    assert not np.array_equal(mug.T_cam_obj, boxed.T_cam_obj)
    for result in (box, mug):
        true = POSES[result.name][2]
        assert np.linalg.norm(result.T_cam_obj[:3, 3] - true) < 0.1 * np.linalg.norm(true)
        assert result.distance_mm == pytest.approx(np.linalg.norm(result.T_cam_obj[:3, 3]))
        R = Rotation.from_quat(result.quaternion_xyzw).as_matrix()
        np.testing.assert_allclose(R, result.T_cam_obj[:3, :3], atol=1e-9)


def test_a_depth_image_gives_the_distance(estimator, folder):
    rgb, mask = read(folder / "shot.png"), read(folder / "mug_mask.png")
    mesh, (_, angles, t) = make_object(3), POSES["mug"]
    T = rigid(Rotation.from_euler("xyz", angles, degrees=True).as_matrix(), np.array(t))
    depth_mm = Raycast().render(mesh, K, T[None], SIZE_HW)[1][0]
    K_long = K * [[1.03, 1, 1], [1, 1.03, 1], [1, 1, 1]]  # RGB alone places the object 3 % too far away
    without = estimator(rgb, K_long, mask=mask, name="mug")
    fitted = estimator(rgb, K_long, mask=mask, name="mug", depth_mm=depth_mm)
    metres = estimator(rgb, K_long, mask=mask, name="mug", depth_mm=depth_mm / 1000)
    assert any("depth_scale=1000 times the present one fits" in warning for warning in metres.warnings)
    assert not any("depth" in warning for warning in fitted.warnings)
    assert without.T_cam_obj[2, 3] == pytest.approx(515, abs=4)
    assert fitted.T_cam_obj[2, 3] == pytest.approx(500, abs=4)
    with pytest.raises(BadInput, match=r"depth_mm: found shape \(3, 3\), needs that of the image, 240 x 320"):
        estimator(rgb, K, mask=mask, name="mug", depth_mm=np.zeros((3, 3)))


def test_a_depth_image_is_used_inside_a_box_alone(folder):
    mesh, (_, angles, t) = make_object(3), POSES["mug"]
    T = rigid(Rotation.from_euler("xyz", angles, degrees=True).as_matrix(), np.array(t))
    rgb, depth_mm = (images[0] for images in Raycast().render(mesh, K, T[None], SIZE_HW))
    farther_mm = np.where(depth_mm > 0, depth_mm + 25, 0)  # as if K were 5 % off
    with PoseEstimator.from_mesh(
        folder / "mug.ply", settings=[*SMALL, "segment=none"], cache=folder / "cache"
    ) as estimator:
        result = estimator(rgb, K, bbox=[100, 55, 170, 140], depth_mm=farther_mm)
    assert result.T_cam_obj[2, 3] == pytest.approx(525, abs=10)  # 500 from RGB alone, and a rotation that is rough


def test_an_overlay_shows_the_pose_and_its_axes(estimator, folder):
    rgb, mask = read(folder / "shot.png"), read(folder / "mug_mask.png")
    overlay = estimator(rgb, K, mask=mask, name="mug").overlay()
    assert overlay.shape == (4 * SIZE_HW[0], 4 * SIZE_HW[1], 3)
    for colour in ((235, 60, 60), (70, 200, 80), (70, 120, 255)):
        assert (np.abs(overlay.astype(int) - colour).max(-1) < 12).sum() > 50


def test_calls_of_several_threads_give_the_same_pose(estimator, folder):
    rgb, mask, found = read(folder / "shot.png"), read(folder / "mug_mask.png"), []
    threads = [
        threading.Thread(target=lambda: found.append(estimator(rgb, K, mask=mask, name="mug").T_cam_obj))
        for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 3
    assert all(np.array_equal(T, found[0]) for T in found)


def test_without_a_pose_there_is_a_reason(folder):
    strict = ["solve.min_inliers=100000", *SMALL]
    with PoseEstimator.from_mesh(folder / "mug.ply", settings=strict, cache=folder / "cache") as estimator:
        result = estimator(read(folder / "shot.png"), K, mask=read(folder / "mug_mask.png"))
    assert (result.found, result.T_cam_obj, result.quaternion_xyzw, result.score) == (False, None, None, None)
    assert result.stage == "solve"
    assert "needs 100000" in result.reason
    assert result.summary().startswith("mug: no pose: solve: ")
    assert result.overlay().shape[2] == 3


def test_a_suspicious_mask_is_a_warning(estimator, folder):
    result = estimator(read(folder / "shot.png"), K, mask=np.ones(SIZE_HW, bool), name="box")
    assert "image, box: the mask covers 100% of the image; is it the object's, and not inverted?" in result.warnings


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"rgb": np.zeros((8, 8, 3))}, "rgb: found float64 of shape (8, 8, 3), needs uint8 of shape (h, w, 3), in RGB"),
        ({"mask": np.ones((8, 8), bool)}, "mask: found shape (8, 8), needs that of the image, 240 x 320"),
        ({"mask": np.zeros(SIZE_HW, bool)}, "mask: found an empty mask, needs the object's pixels not 0"),
        ({"bbox": [0, 0, 5, 5]}, "mask, bbox: found both, needs one of them"),
        ({"mask": None, "bbox": [0, 0, 5]}, "bbox: found 3 numbers, needs 4: [x,y,width,height]"),
        ({"mask": None}, "detect: found a search whose results nothing could verify, needs a method with"),
        ({"rgb": np.zeros((0, 0, 3), np.uint8)}, "rgb: found uint8 of shape (0, 0, 3), needs uint8 of shape (h, w, 3)"),
        ({"mask": np.array([[None] * 3] * 3)}, "mask, bbox: found an array of object and shape (3, 3), needs a mask"),
        ({"depth_mm": np.array(["d.png"])}, "depth_mm: found an array of <U5, needs numbers of shape (h, w), in mm"),
        ({"depth_mm": np.ones(SIZE_HW, complex)}, "depth_mm: found an array of complex128, needs numbers"),
        ({"K": np.eye(4)}, "K: found 16 numbers, needs [fx,fy,cx,cy] or the 9 of the matrix, row by row"),
        ({"K": [600, 600, 2000, 1500]}, "K: found cx 2000, cy 1500, needs a principal point in or near the image"),
        ({"name": "cup"}, "name: found 'cup', needs one of mug, box"),
        ({"name": None}, "name: found nothing, needs one of mug, box"),
    ],
)
def test_an_error_names_the_argument(estimator, folder, given, message):
    good = {"rgb": read(folder / "shot.png"), "K": K, "mask": read(folder / "mug_mask.png"), "name": "mug"}
    with pytest.raises(BadInput) as raised:
        estimator(**good | given)
    assert message in str(raised.value)


@pytest.mark.parametrize("wrong", ["abc", [[300, 0], [0, 300, 120]], None, 300.0, [300, 300, 160], np.zeros((2, 2, 3))])
def test_a_camera_that_is_no_matrix_is_refused(estimator, folder, wrong):
    rgb, mask = read(folder / "shot.png"), read(folder / "mug_mask.png")
    with pytest.raises(BadInput, match=r"^K: found .*needs "):
        estimator(rgb, wrong, mask=mask, name="mug")


def test_settings_that_do_not_exist_are_refused(folder):
    with pytest.raises(BadInput, match=r"settings: found Could not override 'match\.tpo_k'"):
        PoseEstimator.from_mesh(folder / "mug.ply", settings=["match.tpo_k=3"])


UNCLOSED = """
import sys
from pipeline import PoseEstimator

estimator = PoseEstimator.from_mesh(sys.argv[1], settings=sys.argv[3:], cache=sys.argv[2])
print(estimator.names)
"""


def test_a_program_that_does_not_close_its_estimator_ends(folder, estimator):
    arguments = [str(folder / "mug.ply"), str(folder / "cache"), *SMALL]
    ran = subprocess.run([sys.executable, "-c", UNCLOSED, *arguments], capture_output=True, text=True, timeout=60)
    assert (ran.returncode, ran.stdout.splitlines()[-1:]) == (0, ["('mug',)"]), ran.stderr


HEAVY = ("torch", "zarr", "scipy", "cv2", "diffusers", "hydra")
LAZY = f"import sys, pipeline; print([name for name in {HEAVY} if name in sys.modules])"
HELP = f"""
import sys
sys.argv = ["dzop", "--help"]
from pipeline.__main__ import main
try:
    main()
finally:
    print("LOADED", [name for name in {HEAVY} if name in sys.modules])
"""


def test_importing_the_package_and_help_load_nothing_slow():
    ran = [subprocess.run([sys.executable, "-c", code], capture_output=True, text=True) for code in (LAZY, HELP)]
    assert ran[0].stdout == "[]\n"
    assert ran[1].stdout.endswith("LOADED ['hydra']\n")
