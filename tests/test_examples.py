"""The scripts of examples/ run; the ROS 2 node runs with stub modules of the same interfaces."""

import csv
import importlib.util
import io
import json
import runpy
import sys
import types
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import PIL.Image
import pytest
from scipy.spatial.transform import Rotation

from pipeline.bop.camera_files import read_camera
from pipeline.functional.rigid import rigid
from pipeline.io.meshes import write_ply
from pipeline.stages.render.raycast import Raycast
from pipeline.synthetic.objects import make_object

EXAMPLES = Path(__file__).parents[1] / "examples"
K, SIZE_HW = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]), (240, 320)
SMALL = ["method=dzop_x", "extract=hog", "render.count=30", "render.size=128", "runtime.device=cpu"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """mug.ply, frames/0.png and 1.png, masks of the same names, camera.json; templates in cache/."""
    folder = tmp_path_factory.mktemp("example")
    write_ply(folder / "mug.ply", make_object(3))
    for name in ("frames", "masks"):
        (folder / name).mkdir()
    for n in range(2):
        R = Rotation.from_euler("xyz", [60, 20 + 5 * n, 30], degrees=True).as_matrix()
        rgb, depth_mm = Raycast().render(make_object(3), K, rigid(R, np.array([20.0, 10, 500]))[None], SIZE_HW)
        PIL.Image.fromarray(rgb[0]).save(folder / "frames" / f"{n}.png")
        PIL.Image.fromarray((depth_mm[0] > 0) * np.uint8(255)).save(folder / "masks" / f"{n}.png")
    (folder / "camera.json").write_text(json.dumps({"fx": 300, "fy": 300, "cx": 160, "cy": 120}))
    return folder


def run_example(monkeypatch, capsys, folder: Path, name: str, *arguments: str) -> str:
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", [name, *arguments, "--set", *SMALL])
    capsys.readouterr()
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    return capsys.readouterr().out


def test_own_object(folder, monkeypatch, capsys):
    given = ("mug.ply", "frames/0.png", "masks/0.png", "300,300,160,120", "--out", "one")
    out = run_example(monkeypatch, capsys, folder, "01_own_object.py", *given)
    assert out.startswith("mug: score ")
    (pose,) = json.loads((folder / "one" / "pose.json").read_text())["poses"]
    assert np.abs(np.array(pose["T_cam_obj"])[:2, 3] - [20, 10]).max() < 10
    assert (folder / "one" / "pose.html").stat().st_size < 1_500_000


def test_video(folder, monkeypatch, capsys):
    out = run_example(monkeypatch, capsys, folder, "02_video.py", "mug.ply", "frames", "masks", "camera.json")
    rows = list(csv.DictReader(io.StringIO(out)))
    assert [row["frame"] for row in rows] == ["0.png", "1.png"]
    assert all(400 < float(row["z_mm"]) < 600 for row in rows)


def test_many_objects(folder, monkeypatch, capsys):
    objects = ["cup=mug.ply:masks/0.png", "mug=mug.ply:masks/0.png"]
    given = ("frames/0.png", "300,300,160,120", *objects, "--out", "many")
    out = run_example(monkeypatch, capsys, folder, "03_many_objects.py", *given)
    assert [line.split(":")[0] for line in out.splitlines()] == ["cup", "mug"]


def photograph_board(K: np.ndarray, T_cam_board: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """A chessboard of 6 x 5 squares of 30 mm as a camera with this distortion sees it."""
    px_mm, margin = 4, 30
    squares = np.indices((5, 6)).sum(0) % 2
    board = np.pad(np.kron(squares, np.ones((30 * px_mm, 30 * px_mm))) * 255, margin * px_mm, constant_values=255)
    board_px = np.diag([px_mm, px_mm, 1.0])
    board_px[:2, 2] = margin * px_mm
    homography = K @ T_cam_board[:3, [0, 1, 3]] @ np.linalg.inv(board_px)
    ideal = cv2.warpPerspective(board.astype(np.uint8), homography, (640, 480), borderValue=128)
    pixels = np.stack(np.meshgrid(np.arange(640.0), np.arange(480.0)), -1).reshape(-1, 1, 2)
    straight = cv2.undistortPoints(pixels, K, distortion, P=K).reshape(480, 640, 2).astype(np.float32)
    return cv2.GaussianBlur(cv2.remap(ideal, straight[..., 0], straight[..., 1], cv2.INTER_LINEAR), (0, 0), 0.8)


def test_calibrate_finds_the_camera_of_chessboards(tmp_path, monkeypatch, capsys):
    K_true, distortion = np.array([[700.0, 0, 330], [0, 710, 250], [0, 0, 1]]), np.array([-0.12, 0.05, 0, 0])
    for n, tilt in enumerate(
        ([0, 0, 0], [25, 5, 0], [-25, 0, 10], [0, 30, 0], [5, -30, -10], [20, 20, 5], [-20, 25, 0])
    ):
        R = Rotation.from_euler("xyz", tilt, degrees=True).as_matrix()
        T = rigid(R, np.array([0, 0, 380.0]) - R @ np.array([90, 75, 0]))
        PIL.Image.fromarray(photograph_board(K_true, T, distortion)).save(tmp_path / f"{n}.png")
    boards = sorted(str(path) for path in tmp_path.glob("*.png"))
    monkeypatch.setattr(sys, "argv", ["04", *boards, "--corners", "5x4", "--out", str(tmp_path / "camera.json")])
    runpy.run_path(str(EXAMPLES / "04_calibrate.py"), run_name="__main__")
    assert "(good); written" in capsys.readouterr().out
    camera = read_camera(tmp_path / "camera.json")
    np.testing.assert_allclose(camera.K, K_true, rtol=0.01, atol=4)
    assert camera.size_hw == (480, 640)
    assert camera.distortion[0] == pytest.approx(-0.12, abs=0.04)
    monkeypatch.setattr(sys, "argv", ["04", *boards, "--corners", "9x6"])
    with pytest.raises(SystemExit, match="found the board in 0 photographs, needs 3"):
        runpy.run_path(str(EXAMPLES / "04_calibrate.py"), run_name="__main__")


def test_notebook(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    cells = json.loads((EXAMPLES / "05_notebook.ipynb").read_text())["cells"]
    parameters, *others = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    names: dict = {}
    exec(parameters, names)
    assert names["K"] == [600, 600, 320, 240]
    names |= {"image": "frames/0.png", "mask": "masks/0.png", "K": [300, 300, 160, 120], "settings": SMALL}
    for source in others:
        exec(source, names)
    names["estimator"].close()
    assert capsys.readouterr().out.startswith("mug: score ")
    assert (folder / "results" / "notebook" / "pose.html").is_file()


# --- ROS 2 -----------------------------------------------------------------------------------------------------------


def fields(**defaults):
    """A message class whose instances have these fields; a callable default makes a new value for each instance."""

    def __init__(self, **given):  # noqa: N807
        vars(self).update({n: v() if callable(v) else v for n, v in defaults.items()} | given)

    return type("Message", (), {"__init__": __init__})


XYZ, XYZW = fields(x=0.0, y=0.0, z=0.0), fields(x=0.0, y=0.0, z=0.0, w=1.0)
POSE = fields(position=XYZ, orientation=XYZW)
HEADER = fields(stamp=0, frame_id="")


class StubNode:
    parameters: dict = {}  # noqa: RUF012

    def __init__(self, name):
        self.published, self.log = [], []

    def declare_parameter(self, name, default):
        self.parameters = {name: default} | self.parameters

    def get_parameter(self, name):
        return SimpleNamespace(value=self.parameters[name])

    def create_publisher(self, kind, topic, depth):
        return SimpleNamespace(publish=self.published.append)

    def create_subscription(self, kind, topic, callback, depth):
        return callback

    def get_logger(self):
        return SimpleNamespace(warning=self.log.append, error=self.log.append)


def stub_modules(sent: list) -> dict[str, types.ModuleType]:
    synchronizer = SimpleNamespace(registerCallback=lambda callback: None)
    contents = {
        "rclpy": {"init": None, "spin": None},
        "rclpy.node": {"Node": StubNode},
        "message_filters": {"Subscriber": lambda *a: a, "TimeSynchronizer": lambda *a: synchronizer},
        "tf2_ros": {"TransformBroadcaster": lambda node: SimpleNamespace(sendTransform=sent.append)},
        "sensor_msgs": {},
        "sensor_msgs.msg": {"Image": fields(), "CameraInfo": fields()},
        "geometry_msgs": {},
        "geometry_msgs.msg": {
            "TransformStamped": fields(
                header=HEADER, child_frame_id="", transform=fields(translation=XYZ, rotation=XYZW)
            )
        },
        "vision_msgs": {},
        "vision_msgs.msg": {
            "Detection3DArray": fields(header=HEADER, detections=list),
            "Detection3D": fields(header=HEADER, results=list, bbox=fields(center=POSE, size=XYZ)),
            "ObjectHypothesisWithPose": fields(hypothesis=fields(class_id="", score=0.0), pose=fields(pose=POSE)),
        },
    }
    modules = {name: types.ModuleType(name) for name in contents}
    for name, values in contents.items():
        vars(modules[name]).update(values)
    return modules


def message(pixels: np.ndarray, encoding: str) -> SimpleNamespace:
    padded = np.pad(pixels.reshape(len(pixels), -1), ((0, 0), (0, 5)))
    h, w = pixels.shape[:2]
    header = HEADER(stamp=7, frame_id="camera_optical")
    data = padded.tobytes()
    return SimpleNamespace(header=header, height=h, width=w, step=padded.shape[1], encoding=encoding, data=data)


def test_the_ros_node_publishes_metres_in_the_images_frame(folder, monkeypatch):
    sent: list = []
    for name, module in stub_modules(sent).items():
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location("pose_node", EXAMPLES / "ros2" / "pose_node.py")
    node_module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(node_module)
    StubNode.parameters = {"mesh": str(folder / "mug.ply"), "cache": str(folder / "cache"), "settings": SMALL}
    rgb, mask = (np.asarray(PIL.Image.open(folder / name / "0.png")) for name in ("frames", "masks"))
    node = node_module.PoseNode()
    images = message(rgb[..., ::-1], "bgr8"), message(mask, "mono8")
    node.on_image(*images)
    assert node.log == ["no camera_info yet"]
    P = np.hstack([K, np.zeros((3, 1))])
    node.on_camera_info(SimpleNamespace(k=np.zeros(9), p=P.ravel()))
    node.on_image(*images)
    (array,), (transform,) = node.published, sent
    (detection,) = array.detections
    (result,) = detection.results
    assert (array.header.frame_id, array.header.stamp, transform.child_frame_id) == ("camera_optical", 7, "mug")
    assert result.hypothesis.class_id == "mug"
    at = result.pose.pose.position
    assert np.abs([at.x - 0.02, at.y - 0.01]).max() < 0.01
    assert 0.4 < at.z < 0.6
    assert transform.transform.translation.z == at.z
    assert detection.bbox.size.x == pytest.approx(np.ptp(make_object(3).vertices[:, 0]) / 1000, rel=1e-5)
    node.on_image(message(rgb, "yuv422"), images[1])
    assert "yuv422: found an unsupported encoding" in node.log[-1]
    assert len((EXAMPLES / "ros2" / "pose_node.py").read_text().splitlines()) <= 150
    node.estimator.close()
