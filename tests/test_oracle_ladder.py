"""The oracle ladder's rungs see the truth, nothing else does, and what they see is part of their keys."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from presets import QUICK

from pipeline.bop.dataset import open_dataset
from pipeline.errors import BadInput
from pipeline.functional.rigid import rotation_angle_deg, rotation_between
from pipeline.graph import Context, Graph
from pipeline.items.poses import NoEstimate
from pipeline.items.records import answer_from_record, answer_to_record
from pipeline.spec import Runtime
from pipeline.stages.choose.oracle import Oracle as ChooseOracle
from pipeline.stages.correspond.oracle import Oracle as CorrespondOracle
from pipeline.stages.extract.coordinates import Coordinates
from pipeline.stages.match.cosine import Cosine
from pipeline.stages.match.oracle import Oracle
from pipeline.stages.solve.epnp import Epnp
from pipeline.store import LocalStoreConfig, Store
from pipeline.synthetic.scenes import write_dataset

ORACLES = {
    "match": {"match": Oracle()},
    "correspond": {"correspond": CorrespondOracle()},
    "choose": {"choose": ChooseOracle()},
}


@pytest.fixture
def scene(tmp_path) -> Path:
    root = tmp_path / "scene"
    write_dataset(root, objects=2, images=3, seed=5, size_hw=(240, 320), per_image=2, occluded=0.0, progress=False)
    return root


def graph_of(scene: Path, **changes: object) -> Graph:
    data, store = open_dataset(scene, name="toy"), Store(LocalStoreConfig(root=str(scene.parent / "cache")))
    stages = replace(QUICK, **changes)
    return Graph(Context(stages, data, data.targets, store, Runtime(progress=False, device="cpu")))


def turn_all_poses(scene: Path) -> None:
    """Other true rotations beside the same images and masks."""
    (path,) = scene.glob("*/*/scene_gt.json")
    truths = json.loads(path.read_text())
    half_turn = np.diag([-1.0, -1.0, 1.0])
    for instance in (instance for of_image in truths.values() for instance in of_image):
        instance["cam_R_m2c"] = (np.reshape(instance["cam_R_m2c"], (3, 3)) @ half_turn).ravel().tolist()
    path.write_text(json.dumps(truths))


@pytest.mark.parametrize("oracle", ORACLES)
def test_other_true_poses_are_other_poses_for_an_oracle_and_the_same_for_everything_else(scene, oracle):
    before = [graph_of(scene, **changes).poses.run_ref().key for changes in ({}, ORACLES[oracle])]
    turn_all_poses(scene)
    after = [graph_of(scene, **changes).poses.run_ref().key for changes in ({}, ORACLES[oracle])]
    assert before[0] == after[0]
    assert before[1] != after[1]


@pytest.mark.parametrize(("changes", "shown"), [({}, False), *((changes, True) for changes in ORACLES.values())])
def test_a_query_carries_the_truth_for_an_oracle_alone(scene, changes, shown):
    graph = graph_of(scene, **changes)
    image = graph.context.image_ids[0]
    found = graph.queries.make_crops(image)
    graph.queries.make_features(image, found)
    query, _ = graph.poses.query(found[0])
    assert (query.truth is not None) == shown


def test_no_matcher_comes_nearer_to_the_true_view_than_the_oracle(scene):
    matched = {}
    for name, match in (("oracle", Oracle()), ("cosine", Cosine())):
        graph = graph_of(scene, match=match)
        matched[name] = [view_error_deg(graph, answer) for answer in graph.estimate()]
    oracle, cosine = (np.array(matched[name]) for name in ("oracle", "cosine"))
    assert len(oracle) == 6
    assert (oracle <= cosine + 1e-9).all()
    assert oracle.mean() < cosine.mean()


def view_error_deg(graph: Graph, answer) -> float:
    """Angle from the matched template to the true pose as it would look on the optical axis."""
    truth = graph.context.dataset.ground_truth(answer.scene_id, answer.im_id)[answer.gt_id].T_cam_obj
    views = graph.templates.read_views(answer.obj_id, [answer.template_id])
    true = rotation_between(truth[:3, 3], np.array([0.0, 0, 1])) @ truth[:3, :3]
    symmetric = true @ graph.context.model(answer.obj_id).symmetries[:, :3, :3]
    return float(rotation_angle_deg(np.broadcast_to(views.T_cam_obj[0, :3, :3], symmetric.shape), symmetric).min())


def test_true_templates_and_coordinates_go_together(scene):
    answers = graph_of(scene, match=Oracle(), extract=Coordinates()).estimate()
    assert not [answer for answer in answers if isinstance(answer, NoEstimate)]


def test_an_answer_without_a_pose_keeps_its_template_and_old_records_still_read(scene):
    graph = graph_of(scene, solve=Epnp(min_inliers=100000))
    answers = graph.estimate()
    assert all(isinstance(answer, NoEstimate) and answer.template_id is not None for answer in answers)
    record = answer_to_record(answers[0])
    assert answer_from_record(record) == answers[0]
    del record["template_id"]
    assert answer_from_record(record).template_id is None


def test_without_ground_truth_behind_a_detection_the_oracle_says_what_it_needs(scene):
    graph = graph_of(scene, match=Oracle())
    graph.queries.detections[:] = [type(d)(**{**vars(d), "gt_id": None}) for d in graph.queries.detections]
    with pytest.raises(BadInput, match="match=oracle: found detections without ground truth, needs detect=gt_mask or"):
        graph.poses.run_ref()
