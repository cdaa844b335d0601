"""The page of one photograph: it is small, needs nothing outside itself, and its 3D view turns."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.errors import DzopError
from pipeline.functional.rigid import rigid
from pipeline.io.meshes.simplify import thin_mesh
from pipeline.items.objects import Mesh, ObjectModel
from pipeline.items.poses import Alternative, PoseEstimate
from pipeline.items.views import Image
from pipeline.outputs import photo_files
from pipeline.outputs.photo_files import holds_results, link_latest, save_results
from pipeline.outputs.pose_result import PoseResult, confidence_warnings
from pipeline.report.pose_page import MAX_BYTES, PosePage, ShownPose
from pipeline.synthetic.objects import make_object

K = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
T = rigid(cv2.Rodrigues(np.array([0.3, 1.0, -0.5]))[0], np.array([20.0, 10, 600]))
NOISE = np.random.default_rng(0).integers(0, 255, (480, 640, 3), np.uint8)


def result(**given) -> PoseResult:
    mesh = make_object(3)
    shown = {"image": Image(0, 0, NOISE, K), "model": ObjectModel(1, mesh, 100.0), "mesh": "mug.ply"}
    known = {"name": "mug", "T_cam_obj": T, "score": 0.9, "inliers": 9, "correspondences": 10}
    return PoseResult(**known | shown | given)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("shot")
    card = np.zeros((1000, 486, 3), np.uint8)
    save_results([result(warnings=("<b>odd</b> mask",))], folder, image="a/shot.png", cards=lambda: [card])
    return folder


def test_a_pose_is_found_in_a_small_file_with_units_and_frame_in_words(folder):
    record = json.loads((folder / "pose.json").read_text())
    (pose,) = record["poses"]
    assert record["units"] == "mm"
    assert "object to the camera" in record["frame"]
    assert (record["image"], record["K"]) == ("a/shot.png", [600, 600, 320, 240])
    assert record["warnings"] == ["<b>odd</b> mask"]
    assert np.array_equal(pose["T_cam_obj"], T)
    assert (pose["name"], pose["mesh"], pose["status"], pose["confidence"]) == ("mug", "mug.ply", "estimate", None)
    assert (folder / "pose.json").stat().st_size < 4000


def test_the_page_is_small_and_refers_to_nothing_outside(folder):
    page = (folder / "pose.html").read_text()
    assert len(page.encode()) <= MAX_BYTES  # noise is the largest photograph of its size
    assert re.findall(r"""(?:src|href|url|@import)\s*[=(]\s*["']?(?!data:)\w""", page.split('id="viewer"')[0]) == []
    assert "&lt;b&gt;odd" in page


def test_a_large_photograph_becomes_smaller_until_the_page_fits():
    noise = np.random.default_rng(1).integers(0, 255, (1500, 2000, 3), np.uint8)
    page = PosePage("shot", noise, noise, [ShownPose("mug", "mug: no pose", None)], scene="x" * 800_000)
    assert len(page.html().encode()) <= MAX_BYTES


def test_without_a_pose_the_page_says_why_and_has_no_view_in_space(tmp_path):
    save_results([result(T_cam_obj=None, score=None, stage="solve", reason="3 inliers, needs 6")], tmp_path)
    page = (tmp_path / "pose.html").read_text()
    assert "no pose: solve: 3 inliers, needs 6" in page
    assert "<iframe" not in page
    (pose,) = json.loads((tmp_path / "pose.json").read_text())["poses"]
    assert (pose["status"], pose["T_cam_obj"], pose["reason"]) == ("none", None, "3 inliers, needs 6")


def test_other_poses_are_in_the_file_and_on_the_page(tmp_path):
    save_results([result(confidence=0.6, decision="check", alternatives=(Alternative(T, 0.9, 0.3),))], tmp_path)
    page = (tmp_path / "pose.html").read_text()
    assert "mug: confidence 0.60 (check), at 600 mm" in page
    assert "or, 90% as well explained, probability 0.30" in page
    (pose,) = json.loads((tmp_path / "pose.json").read_text())["poses"]
    assert (pose["confidence"], pose["decision"]) == (0.6, "check")
    (other,) = pose["alternatives"]
    assert (other["T_cam_obj"], other["support"], other["weight"]) == (T.tolist(), 0.9, 0.3)


@pytest.mark.parametrize("name", ["overlay.jpg", "pose.html", "pose.json"])
def test_a_write_that_fails_leaves_no_mixture_that_counts_as_finished(tmp_path, monkeypatch, name):
    shown = {"overlay": True}
    save_results([result()], tmp_path, more={"made_from": "first"})
    assert holds_results(tmp_path, "first", **shown)

    def fail(path: Path, *given, **more):
        if path.name == name:
            raise DzopError("the disk is full")
        return whole[name](path, *given, **more)

    writers = {"overlay.jpg": "write_overlay", "pose.html": "write_atomic", "pose.json": "write_json"}
    whole = {name: getattr(photo_files, writers[name])}
    with monkeypatch.context() as patch:
        patch.setattr(photo_files, writers[name], fail)
        with pytest.raises(DzopError):
            save_results([result(score=0.5)], tmp_path, more={"made_from": "second"})
    assert not holds_results(tmp_path, "second", **shown)
    assert holds_results(tmp_path, "first", **shown) == (name == "overlay.jpg")
    save_results([result(score=0.5)], tmp_path, more={"made_from": "second"})
    assert holds_results(tmp_path, "second", **shown)


def test_pictures_of_other_results_do_not_stay_beside_a_new_pose(tmp_path):
    save_results([result()], tmp_path, more={"made_from": "first"})
    save_results([result(score=0.5)], tmp_path, more={"made_from": "second"}, overlay=False)
    assert [path.name for path in tmp_path.iterdir()] == ["pose.json"]
    assert holds_results(tmp_path, "second", overlay=False)
    assert not holds_results(tmp_path, "second", overlay=True)


def test_two_writers_of_one_folder_leave_what_a_later_run_recognises_as_mixed(tmp_path):
    save_results([result()], tmp_path / "one", more={"made_from": "first"})
    save_results([result(score=0.5)], tmp_path / "two", more={"made_from": "second"})
    for name in ("overlay.jpg", "pose.html", "pose.json"):
        mixed = tmp_path / f"mixed {name}"
        shutil.copytree(tmp_path / "one", mixed)
        shutil.copy(tmp_path / "two" / name, mixed / name)
        assert not holds_results(mixed, "first", overlay=True)
        assert not holds_results(mixed, "second", overlay=True)


def estimate(**given) -> PoseEstimate:
    return PoseEstimate(0, 0, 1, 0, T, 0.5, 1.0, 3, 0.8, 0.1, 10, 9, 1.5, **given)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"confidence": 0.95, "decision": "accept"}, ()),
        ({}, ()),
        ({"confidence": 0.5, "decision": "check"}, ("mug: this pose may be wrong (confidence 0.50)",)),
        ({"confidence": 0.04, "decision": "reject"}, ("mug: this pose is probably wrong (confidence 0.04)",)),
        ({"decision": "reject"}, ("mug: this pose is probably wrong: likely causes",)),
    ],
)
def test_a_doubtful_pose_is_said_in_words(given, said):
    lines = confidence_warnings(estimate(**given), "mug")
    assert len(lines) == len(said)
    assert all(line.startswith(text) for line, text in zip(lines, said, strict=True))


def test_latest_points_to_the_last_folder_and_never_replaces_one_of_the_users(tmp_path):
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        link_latest(tmp_path / name)
    assert (tmp_path / "latest").resolve() == tmp_path / "second"
    (tmp_path / "latest").unlink()
    (tmp_path / "latest").mkdir()
    link_latest(tmp_path / "first")
    assert not (tmp_path / "latest").is_symlink()


@pytest.mark.parametrize("faces", [200, 10**6])
def test_a_thin_mesh_keeps_its_colours(faces):
    mesh = make_object(3)
    thin = thin_mesh(mesh, faces, texture_px=16)
    assert len(thin.faces) < len(mesh.faces) or thin is mesh
    assert (thin.colours is None) == (mesh.colours is None and mesh.texture is None)
    square = Mesh(np.eye(3), np.array([[0, 1, 2]]), uv=np.zeros((3, 2)), texture=np.zeros((64, 32, 3), np.uint8))
    assert thin_mesh(square, 10, texture_px=16).texture.shape == (16, 8, 3)


PROBE = """<script>
setTimeout(() => {
  const view = document.getElementById("scene").contentWindow, canvas = view.document.querySelector("canvas");
  const where = () => view.eval("camera.position.toArray()"), before = where();
  const send = (type, x, on) => on.dispatchEvent(new view.PointerEvent(
    type, {clientX: x, clientY: 100, pageX: x, pageY: 100, pointerId: 1, button: 0, buttons: 1, bubbles: true}));
  canvas.setPointerCapture = canvas.releasePointerCapture = () => {};
  send("pointerdown", 100, canvas);
  for (const x of [120, 140, 160]) { send("pointermove", x, canvas); view.eval("controls.update()"); }
  send("pointerup", 160, canvas);
  setTimeout(() => {
    const loaded = [window, view].flatMap((w) => w.performance.getEntriesByType("resource").map((e) => e.name));
    const found = {before, after: where(), width: innerWidth, needed: document.documentElement.scrollWidth,
                   loaded: loaded.filter((name) => !name.startsWith("data:") && !name.startsWith("blob:"))};
    document.title = "PROBE" + JSON.stringify(found) + "END";
  }, 1500);
}, 1500);
</script></body>"""


@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs chromium: apt-get install chromium")
def test_in_a_narrow_browser_the_view_turns_and_nothing_is_requested(folder, tmp_path):
    page = (folder / "pose.html").read_text().replace("</body>", PROBE)
    (tmp_path / "probed.html").write_text(page)
    command = ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--dump-dom"]
    command += ["--window-size=400,900", "--virtual-time-budget=8000", f"--user-data-dir={tmp_path / 'profile'}"]
    ran = subprocess.run(
        [*command, f"file://{tmp_path / 'probed.html'}"], capture_output=True, text=True, timeout=120, check=False
    )
    found = json.loads(re.search(r"PROBE(.*?)END</title>", ran.stdout)[1])
    assert found["loaded"] == []
    assert np.abs(np.subtract(found["before"], found["after"])).max() > 1
    assert found["needed"] <= found["width"] <= 500
