"""Scores of whole datasets: real ground truth, and a tiny dataset where two instances share an image."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiny_bop import edit_json, write_tiny_bop

from pipeline.bop.dataset import Dataset, open_dataset
from pipeline.bop.results import ResultRow
from pipeline.errors import BadInput
from pipeline.functional.rigid import rigid
from pipeline.metrics.recall import average_recall
from pipeline.scoring import Scorer, ScoringResult, truth_digest


def opened(root, name: str, models: str = "models_eval") -> Dataset:
    return open_dataset(root, name=name, models=models, photographs=False)


def true_rows(scorer: Scorer, *, symmetry: int | None = None) -> list[ResultRow]:
    """Ground truth as results; ``symmetry``: rotated by that symmetry of each object."""
    rows = []
    for target in scorer.targets:
        for gt in scorer.scored_instances(target):
            symmetries = scorer.mesh(target.obj_id).model.symmetries
            turn = np.eye(4) if symmetry is None else symmetries[symmetry % len(symmetries)]
            rows.append(ResultRow(target.scene_id, target.im_id, target.obj_id, 1.0, gt.T_cam_obj @ turn, -1.0))
    return rows


@pytest.fixture(scope="module")
def scorers(bop_mini) -> dict[str, Scorer]:
    """Scorers of all targets of the photographs."""
    data = {name: opened(bop_mini / name, name) for name in ("lmo", "ycbv")}
    return {name: Scorer(dataset, dataset.targets, "models_eval") for name, dataset in data.items()}


@pytest.fixture(scope="module")
def score_truth(scorers) -> Callable[..., ScoringResult]:
    """Scores of a dataset's ground truth, computed once."""
    return cache(lambda name, symmetry: scorers[name].score(true_rows(scorers[name], symmetry=symmetry)))


@pytest.mark.parametrize(("name", "symmetry"), [("lmo", None), ("lmo", 1), ("ycbv", None), ("ycbv", 1), ("ycbv", 17)])
def test_ground_truth_scores_one_also_when_rotated_by_a_symmetry(score_truth, name, symmetry):
    recall = average_recall(score_truth(name, symmetry).scores)
    assert (recall.mssd, recall.mspd) == (1.0, 1.0)
    if name == "ycbv":
        assert recall.vsd == recall.ar == 1.0


def test_without_all_depth_images_vsd_is_left_out_with_the_reason(bop_mini, score_truth):
    scored = score_truth("lmo", None)
    assert scored.scores.vsd is None
    assert scored.scores.no_vsd.startswith("39 of 40 images have no depth image")
    assert average_recall(scored.scores).ar is None
    data = opened(bop_mini / "lmo", "lmo")
    only = tuple(t for t in data.targets if t.im_id == 3)
    with_depth = Scorer(data, only, "models_eval")
    assert average_recall(with_depth.score(true_rows(with_depth)).scores).vsd == 1.0


@pytest.fixture
def tiny(tmp_path) -> Scorer:
    data = opened(write_tiny_bop(tmp_path / "tiny"), "tiny", "models")
    return Scorer(data, data.targets, "models")


def test_every_instance_of_a_target_needs_its_own_estimate(tiny):
    rows = true_rows(tiny)
    assert len(rows) == 4
    found = tiny.score(rows).scores
    assert found.instances() == [(7, 0, 1, 0), (7, 0, 1, 1), (7, 0, 2, 2), (7, 3, 2, 0)]
    assert (average_recall(found).mssd, average_recall(found).mspd) == (1.0, 1.0)
    # the wall at 400 mm hides instance 2: nothing of it is visible, which VSD counts as a miss
    assert found.vsd.all(axis=(1, 2)).tolist() == [True, True, False, True]
    # one pose given twice finds one instance
    twice = tiny.score([rows[0], rows[0], *rows[2:]]).scores
    assert twice.mssd.all(axis=1).tolist() == [True, False, True, True]
    assert average_recall(twice).mspd == 0.75


def test_only_inst_count_best_scored_estimates_count(tiny):
    rows = true_rows(tiny)
    wrong = rigid(Rotation.from_euler("x", 90, degrees=True).as_matrix(), np.array([0.0, 0.0, 900.0]))
    better = [ResultRow(7, 3, 2, 2.0, wrong, -1.0), *rows]  # a higher score than the true one's
    assert average_recall(tiny.score(better).scores).mssd == 0.75
    worse = [ResultRow(7, 3, 2, 0.5, wrong, -1.0), *rows]
    assert average_recall(tiny.score(worse).scores).mssd == 1.0


def test_of_more_than_inst_count_instances_the_most_visible_count(tiny, tmp_path):
    edit_json(tmp_path / "tiny" / "test_targets_bop19.json", lambda targets: targets[0].update(inst_count=1))
    data = opened(tmp_path / "tiny", "tiny", "models")
    scorer = Scorer(data, data.targets, "models")
    # instance 0 is half hidden, instance 1 not at all
    assert (7, 0, 1, 1) in scorer.score([]).scores.instances()
    assert (7, 0, 1, 0) not in scorer.score([]).scores.instances()
    (tmp_path / "tiny" / "test" / "000007" / "scene_gt_info.json").unlink()
    data = opened(tmp_path / "tiny", "tiny", "models")
    with pytest.raises(BadInput, match=r"needs scene_gt_info\.json, to take the most visible"):
        Scorer(data, data.targets, "models").score([])


def test_a_missing_estimate_is_a_miss_not_an_error(tiny):
    recall = average_recall(tiny.score([]).scores)
    assert (recall.vsd, recall.mssd, recall.mspd) == (0.0, 0.0, 0.0)


def test_projection_errors_are_in_pixels_of_an_image_640_px_wide(tiny):
    row = true_rows(tiny)[3]
    T = row.T_cam_obj.copy()
    T[0, 3] += 10.0
    shifted = ResultRow(row.scene_id, row.im_id, row.obj_id, 1.0, T, -1.0)
    (errors,) = tiny.score([shifted]).errors
    near = row.T_cam_obj[2, 3] - 40.0  # the near face of object 2 moves most
    assert errors.mspd_px == pytest.approx(80.0 * 10 / near * 640 / 64)
    assert errors.mssd_mm == pytest.approx(10.0)


def test_errors_do_not_depend_on_the_camera_frame(tiny):
    """Errors in the object's frame do not depend on where the camera's axes point."""
    row = true_rows(tiny)[2]
    off = rigid(Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix(), np.array([3.0, -2.0, 5.0]))
    est = row.T_cam_obj @ off
    (errors,) = tiny.score([ResultRow(row.scene_id, row.im_id, row.obj_id, 1.0, est, -1.0)]).errors
    vertices = tiny.mesh(row.obj_id).vertices
    moved = np.linalg.norm(vertices @ off[:3, :3].T + off[:3, 3] - vertices, axis=1)
    assert errors.mssd_mm == pytest.approx(moved.max())
    assert errors.add_mm == pytest.approx(moved.mean())
    assert errors.rotation_deg == pytest.approx(np.rad2deg(np.linalg.norm([0.1, 0.2, 0.3])))


def test_another_annotation_changes_the_digest(tiny, tmp_path):
    before = truth_digest(tiny)
    assert before == truth_digest(tiny)
    path = tmp_path / "tiny" / "test" / "000007" / "scene_gt.json"
    edit_json(path, lambda scenes: scenes["3"][0].update(cam_t_m2c=[10.0, 0.0, 401.0]))
    data = opened(tmp_path / "tiny", "tiny", "models")
    assert truth_digest(Scorer(data, data.targets, "models")) != before
