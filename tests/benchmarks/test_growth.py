"""The parts of make bench that compare versions and measure growth, without their minutes of runs."""

import json

import cv2
import numpy as np
import pytest

from benchmarks.cli_runs import checkout_of, run_dzop
from benchmarks.growth import _plot, _summarise, enlarge_photographs
from pipeline.errors import BadInput, DzopError


def test_enlarged_photographs_keep_their_camera_and_boxes(tmp_path):
    for folder in ("rgb", "mask_visib", "depth"):
        (tmp_path / folder).mkdir()
        cv2.imwrite(str(tmp_path / folder / "000000.png"), np.zeros((30, 40, 3), np.uint8))
    camera = {"0": {"cam_K": [50.0, 0, 20, 0, 50, 15, 0, 0, 1], "depth_scale": 0.1}}
    (tmp_path / "scene_camera.json").write_text(json.dumps(camera))
    (tmp_path / "scene_gt_info.json").write_text(json.dumps({"0": [{"bbox_obj": [2, 4, 6, 8], "px_count_all": 5}]}))
    enlarge_photographs(tmp_path, 4 * 30 * 40 / 1e6)
    image = cv2.imread(str(tmp_path / "rgb" / "000000.png"))
    assert image is not None
    assert image.shape[:2] == (60, 80)
    assert not list((tmp_path / "depth").iterdir())
    K = json.loads((tmp_path / "scene_camera.json").read_text())["0"]["cam_K"]
    assert pytest.approx([100, 0, 40.5, 0, 100, 30.5, 0, 0, 1]) == K  # the centre of pixel 0 is at 0.5 of the larger
    assert json.loads((tmp_path / "scene_gt_info.json").read_text())["0"][0]["bbox_obj"] == [4, 8, 12, 16]


def test_growth_is_compared_with_linear_growth(tmp_path):
    found = {m.name: m for m in _summarise("objects", (1, 10), (0.5, 2.5), (300, 330))}
    assert found["10 objects: time"].value == 2.5
    assert found["objects: growth of the time"].value == pytest.approx(0.5)
    assert found["objects: growth of the time"].verdict == "pass"
    assert found["objects: peak memory"].value == pytest.approx(1.1)
    _plot("objects", (1, 10), (0.5, 2.5), (300, 330)).save(str(tmp_path / "objects"))
    assert (tmp_path / "objects.png").stat().st_size > 1000


def test_an_unknown_commit_and_a_failed_run_are_one_line(tmp_path):
    needed = "--before: found 'no-such-commit', needs a commit of this git checkout"
    with pytest.raises(BadInput, match=needed), checkout_of("no-such-commit"):
        pass
    with pytest.raises(DzopError, match=r"dzop datset=demo in .*: .*"):
        run_dzop(tmp_path, "datset=demo")
