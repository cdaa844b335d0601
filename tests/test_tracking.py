"""Poses of a video: a prior is followed where the images confirm it, and does not mislead where they do not."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import PIL.Image
import pytest
from command import run_dzop
from scipy.spatial.transform import Rotation

from benchmarks.video import OCCLUDED, K, make_video
from pipeline import BadInput, PoseEstimator
from pipeline.functional.rigid import rigid, rotation_angle_deg
from pipeline.functional.viewpoints import superfibonacci
from pipeline.io.meshes import write_ply
from pipeline.route import Route
from pipeline.synthetic.objects import make_object
from pipeline.tracking import TRIED, nearest_views

SMALL = ("method=dzop_x", "extract=hog", "render.count=100", "render.size=96", "runtime.device=cpu")
COUNT = 30


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("video")
    write_ply(folder / "mug.ply", make_object(3))
    return folder


@pytest.fixture(scope="module")
def frames():
    return list(make_video(make_object(3), count=COUNT))


@pytest.fixture(scope="module")
def estimator(folder):
    with PoseEstimator.from_mesh(folder / "mug.ply", settings=SMALL, cache=folder / "cache") as estimator:
        yield estimator


def off(result, frame) -> tuple[float, float]:
    """(degrees, mm) between a result and the truth."""
    T, true = result.T_cam_obj, frame.T_cam_obj
    return float(rotation_angle_deg(T[:3, :3], true[:3, :3])), float(np.linalg.norm(T[:3, 3] - true[:3, 3]))


def test_thirty_frames_have_no_jump_and_one_occluded_frame_recovers(estimator, frames):
    result, found = None, []
    for frame in frames:
        result = estimator(frame.rgb, K, mask=frame.mask, prior=result)
        found.append(off(result, frame))
    clear = np.array([pair for n, pair in enumerate(found) if n != OCCLUDED])
    assert clear[:, 0].max() < 4
    assert clear[:, 1].max() < 12
    z_off = np.diff([f[1] for n, f in enumerate(found) if n != OCCLUDED])
    assert np.std(z_off) < 4


def test_a_wrong_prior_gives_the_pose_without_one(estimator, frames):
    frame = frames[3]
    without = estimator(frame.rgb, K, mask=frame.mask)
    upside_down = frame.T_cam_obj @ np.diag([1.0, -1, -1, 1])
    elsewhere = rigid(Rotation.from_rotvec([2.0, 1, 0]).as_matrix(), np.array([-200.0, 100, 400]))
    for wrong in (upside_down, elsewhere):
        result = estimator(frame.rgb, K, mask=frame.mask, prior=wrong)
        np.testing.assert_allclose(result.T_cam_obj, without.T_cam_obj, atol=1e-9)


def test_a_prior_saves_the_search_of_templates(estimator, frames, monkeypatch):
    compared = []
    compare = Route.compare
    monkeypatch.setattr(Route, "compare", lambda route, start: compared.append(start) or compare(route, start))
    frame = frames[1]
    followed = estimator(frame.rgb, K, mask=frame.mask, prior=frames[0].T_cam_obj)
    with_prior = len(compared)
    alone = estimator(frame.rgb, K, mask=frame.mask)
    assert with_prior <= TRIED + 1 < len(compared) - with_prior
    assert max(off(followed, frame)[1], off(alone, frame)[1]) < 12


def test_without_mask_the_object_is_sought_around_the_prior(estimator, frames):
    result = estimator(frames[1].rgb, K, prior=frames[0].T_cam_obj)
    assert off(result, frames[1])[0] < 6
    with pytest.raises(BadInput, match="detect: found a search whose results nothing could verify"):
        estimator(frames[1].rgb, K, prior=replace(result, decision="reject"))
    with pytest.raises(BadInput, match="prior: found a pose outside the image"):
        estimator(frames[1].rgb, K, prior=rigid(np.eye(3), np.array([5000.0, 0, 500])))


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        (np.eye(3), r"prior: found shape \(3, 3\), needs T_cam_obj, 4 x 4 in mm"),
        (np.diag([2.0, 1, 1, 1]), "prior: found a matrix that is no rotation"),
        (np.eye(4), "prior: found z 0 mm, behind the camera"),
    ],
)
def test_a_prior_that_is_no_pose_is_refused(estimator, frames, prior, message):
    with pytest.raises(BadInput, match=message):
        estimator(frames[0].rgb, K, mask=frames[0].mask, prior=prior)


def test_the_command_follows_a_video(folder, frames, capsys, monkeypatch):
    for name in ("frames", "masks"):
        (folder / name).mkdir()
    for n, frame in enumerate(frames[:3]):
        PIL.Image.fromarray(frame.rgb).save(folder / "frames" / f"{n}.png")
        PIL.Image.fromarray(frame.mask * np.uint8(255)).save(folder / "masks" / f"{n}.png")
    given = ("dataset=photo", f"dataset.mesh={folder}/mug.ply", f"dataset.image={folder}/frames/*.png")
    given += (f"dataset.mask={folder}/masks/*.png", "dataset.K=[600,600,320,240]", f"store.root={folder}/cache")
    ran = run_dzop(capsys, monkeypatch, *given, *SMALL, f"out={folder}/out", "dataset.video=true", "overlays=false")
    assert ran.status == 0, ran.err
    records = json.loads(next(folder.glob("out/*/*/poses.json")).read_text())["answers"]
    with PoseEstimator.from_mesh(folder / "mug.ply", settings=SMALL, cache=folder / "cache") as estimator:
        result = None
        for frame, record in zip(frames, records, strict=False):
            result = estimator(frame.rgb, K, mask=frame.mask, prior=result)
            np.testing.assert_array_equal(result.T_cam_obj, record["T_cam_obj"])
    ran = run_dzop(capsys, monkeypatch, *given, *SMALL, f"out={folder}/out", "dataset.video=true", "second_look=none")
    assert "dataset.video: found with second_look=none, needs method=dzop_x or second_look=drawn" in ran.err


def test_the_nearest_views_are_those_of_the_nearest_copy():
    R = superfibonacci(200)
    templates = rigid(R, np.tile([0.0, 0, 500], (200, 1)))
    half_turn = np.stack([np.eye(4), np.diag([-1.0, -1, 1, 1])])
    T = templates[17] @ half_turn[1]
    assert nearest_views(T, half_turn, templates, count=5)[0] == 17
    assert nearest_views(T, half_turn[:1], templates, count=5)[0] != 17
    aside = rigid(Rotation.from_euler("y", 10, degrees=True).as_matrix(), np.zeros(3)) @ templates[17]
    assert nearest_views(aside, half_turn[:1], templates, count=1)[0] == 17  # seen from the same side, off the axis
