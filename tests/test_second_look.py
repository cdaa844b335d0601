"""A hypothesis drawn at its own pose: where its picture says things are, and what another match makes of the pose."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from presets import QUICK

from pipeline.bop.dataset import Dataset, open_dataset
from pipeline.functional import camera, rigid
from pipeline.functional.masks import foreground
from pipeline.graph import Context, Graph
from pipeline.items.poses import PoseEstimate
from pipeline.method import SecondLook
from pipeline.route import trace_pose
from pipeline.spec import Runtime
from pipeline.stages.choose.agreement import Agreement
from pipeline.stages.cluster.kmeans import KMeans
from pipeline.stages.cluster.one import One
from pipeline.stages.crop.square import Square
from pipeline.stages.crop.virtual import Virtual
from pipeline.stages.extract.embedded import Embedded
from pipeline.stages.fuse import coarsen
from pipeline.stages.fuse.concat import Concat
from pipeline.stages.fuse.learned import Learned
from pipeline.stages.lift import lift
from pipeline.stages.match.masked_cosine import MaskedCosine
from pipeline.stages.refine.featuremetric import Featuremetric
from pipeline.stages.render.pyrender import Pyrender
from pipeline.stages.render.raycast import Raycast
from pipeline.store import LocalStoreConfig, Store
from pipeline.synthetic.scenes import write_dataset

STAGES = replace(
    QUICK,
    render=Raycast(viewpoints="superfibonacci", count=100),
    match=MaskedCosine(top_k=3),
    fuse=Concat(layers=(8, 11)),
    choose=Agreement(),
    refine=Featuremetric(sigmas_cells=(2.0, 1.0, 0.0), max_points=1000),
    second_look=SecondLook(hypotheses=2),
)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> Dataset:
    root = tmp_path_factory.mktemp("second_look") / "scenes"
    write_dataset(root, objects=2, images=4, per_image=2, occluded=0.3, seed=5, progress=False)
    return open_dataset(root, name="second_look")


def graph(scenes: Dataset, cache, **changes: object) -> Graph:
    stages = replace(STAGES, **changes)
    store = Store(LocalStoreConfig(root=str(cache)))
    return Graph(Context(stages, scenes, scenes.targets, store, Runtime(progress=False, device="cpu")))


def estimates(of: Graph) -> list[PoseEstimate]:
    answers = of.estimate()
    assert all(isinstance(answer, PoseEstimate) for answer in answers)
    return answers  # type: ignore[return-value]


@pytest.mark.parametrize("crop", [Square(), Virtual()], ids=["square", "virtual"])
@pytest.mark.parametrize(
    "render", [Raycast(), pytest.param(Pyrender(), marks=pytest.mark.gl)], ids=["raycast", "pyrender"]
)
def test_a_drawn_view_shows_the_object_where_the_querys_crop_would(scenes, cache, crop, render):
    made = graph(scenes, cache, crop=crop, render=replace(render, viewpoints="superfibonacci", count=4))
    made.onboard()
    gt, K = scenes.ground_truth(*scenes.images[0])[0], scenes.K(*scenes.images[0])
    px = camera.project(K, gt.T_cam_obj[:3, 3])
    box = (*(px - 60), *(px + 60))
    size = crop.size
    square = camera.square_crop(box, size=size, padding_ratio=1.2)
    A = square if isinstance(crop, Square) else camera.virtual_crop(box, K, size=size, padding_ratio=1.2)
    drawn = made.templates.bank(gt.obj_id).render(gt.T_cam_obj, A, K)
    assert drawn.rgb.shape == (size, size, 3)
    assert drawn.rgb[drawn.crop.mask.numpy()].any(axis=1).mean() > 0.95
    assert {layer: tuple(maps.shape) for layer, maps in drawn.crop.maps.items()} == {
        layer: made.context.stages.extract.feature_shape(layer) for layer in made.context.stages.layers
    }
    crop_px = camera.grid_xy(foreground(drawn.crop.mask), width=size).double().numpy()
    points = lift(crop_px, drawn.A_crop_img, drawn.depth_mm, drawn.K, drawn.T_cam_obj)
    seen = np.isfinite(points).all(1)
    assert seen.mean() > 0.8  # the rest lies across the outline, where depth is of two surfaces
    shown = camera.apply_homography(A, camera.project(K, rigid.transform(gt.T_cam_obj, points[seen])))
    np.testing.assert_allclose(shown, crop_px[seen], atol=1e-6)


@pytest.mark.slow
def test_a_second_look_brings_poses_nearer_and_is_traced_again_as_it_was(scenes, cache):
    errors = {}
    for looks in (0, 2):
        made = graph(scenes, cache, second_look=SecondLook(hypotheses=looks))
        answers, off = estimates(made), []
        for answer in answers:
            (true,) = [g for g in scenes.ground_truth(answer.scene_id, answer.im_id) if g.gt_id == answer.gt_id]
            points = made.context.model(answer.obj_id).mesh.vertices
            moved = rigid.transform(answer.T_cam_obj, points) - rigid.transform(true.T_cam_obj, points)
            off.append(np.linalg.norm(moved, axis=1).mean() / np.ptp(points, axis=0).max())
            assert ("rerender" in answer.times_s) == (looks > 0)
        errors[looks] = float(np.median(off))
        traced = made.replayer()(answers[0])
        assert traced is not None
        np.testing.assert_array_equal(traced.hypothesis.solution.T_cam_obj, answers[0].T_cam_obj)
        assert (traced.hypothesis.rerendered is not None) == (looks > 0)
    assert errors[2] < 0.8 * errors[0], errors


def test_poses_of_another_number_of_looks_have_keys_of_their_own(scenes, cache):
    keys = {n: graph(scenes, cache, second_look=SecondLook(hypotheses=n)).poses.run_ref().key for n in (0, 1, 2)}
    assert len(set(keys.values())) == 3


def test_where_the_drawn_view_shows_nothing_the_first_look_answers(scenes, cache):
    made = graph(scenes, cache, second_look=SecondLook(hypotheses=1))
    made.onboard()
    found = made.queries.make_crops(scenes.images[0])
    made.queries.make_features(scenes.images[0], found)
    query, bank = made.poses.query(found[0])[0], made.templates.bank(found[0].detection.obj_id)
    behind = rigid.rigid(np.eye(3), np.array([0.0, 0.0, -500.0]))
    nothing = bank.render(behind, query.A_crop_img, query.K)
    assert not nothing.crop.mask.any()
    kept = trace_pose(made.context.stages, query, replace(bank, render=lambda *pose: nothing)).best
    first = trace_pose(replace(made.context.stages, second_look=SecondLook()), query, bank).best
    assert kept.rerendered is None
    np.testing.assert_array_equal(kept.solution.T_cam_obj, first.solution.T_cam_obj)


def test_maps_that_are_encoded_independently_are_clustered_once(scenes, cache, monkeypatch):
    chosen = {"extract": Embedded(), "match": MaskedCosine(top_k=3), "fuse": Learned(), "cluster": KMeans(count=30)}
    made = graph(scenes, cache, render=Raycast(viewpoints="superfibonacci", count=12), **chosen)
    made.onboard()
    found = made.queries.make_crops(scenes.images[0])
    made.queries.make_features(scenes.images[0], found)
    query, bank = made.poses.query(found[0])[0], made.templates.bank(found[0].detection.obj_id)
    calls, encode = [], KMeans.encode
    monkeypatch.setattr(KMeans, "encode", lambda self, *maps: calls.append(0) or encode(self, *maps))
    trace = trace_pose(made.context.stages, query, bank)
    looks = sum(hypothesis.rerendered is not None for hypothesis in trace.hypotheses)
    assert len(calls) == 1 + 3 + looks  # the query, the templates, the rerendered views
    trace_pose(made.context.stages, replace(query), bank)  # another query that is matched with the same templates
    assert len(calls) == 2 + 3 + 2 * looks
    other = replace(made.context.stages, cluster=KMeans(count=10))  # other clusters are none of those
    assert trace_pose(other, query, bank).best.clusters.query_label.max() == 9
    for hypothesis in trace.hypotheses:
        view = hypothesis.rerendered or bank.view(hypothesis.template_id)
        pair = Learned()(query.crop, view.crop)
        assert torch.equal(pair.query, hypothesis.pair.query)
        assert torch.equal(pair.template, hypothesis.pair.template)
        clusters = KMeans(count=30)(pair)
        assert torch.equal(clusters.query_label, hypothesis.clusters.query_label)
        assert torch.equal(clusters.pairs, hypothesis.clusters.pairs)


def test_a_plan_counts_the_passes_of_second_looks(scenes, cache):
    made = graph(scenes, cache, second_look=SecondLook(hypotheses=3))
    made.detect()
    nodes = [node for node in made.plan() if node.step == "poses"]
    assert sum(node.passes for node in nodes) == 3 * len(scenes.targets)


@pytest.fixture(scope="module")
def encoded(scenes, tmp_path_factory) -> Graph:
    look = SecondLook(hypotheses=1, block=2, solved=2)
    chosen = {"extract": Embedded(), "match": MaskedCosine(top_k=4), "fuse": Learned(), "cluster": One()}
    render = Raycast(viewpoints="superfibonacci", count=12)
    return graph(scenes, tmp_path_factory.mktemp("encoded"), render=render, second_look=look, **chosen)


def test_encodings_of_templates_take_the_planned_bytes_and_are_read_back(encoded):
    encoded.detect()
    planned = {node.ref: node.nbytes for node in encoded.plan() if node.step == "template encodings"}
    encoded.onboard()
    assert len(planned) == 2
    assert planned == {ref: encoded.context.store.size(ref) for ref in planned}
    view = encoded.templates.bank(1).view(3)
    stored, made = view.read_encoding(), coarsen(Learned().encode(view.crop, {}), block=2)
    assert torch.equal(stored.mask, made.mask)
    torch.testing.assert_close(stored.features, made.features, atol=2e-3, rtol=1e-3)  # float16
    assert {node.state for node in encoded.plan() if node.step == "template encodings"} == {"cached"}


def test_the_first_look_solves_the_hypotheses_with_most_matches_on_coarse_maps(encoded, scenes, monkeypatch):
    encoded.onboard()
    found = encoded.queries.make_crops(scenes.images[0])
    encoded.queries.make_features(scenes.images[0], found)
    query, bank = encoded.poses.query(found[0])[0], encoded.templates.bank(found[0].detection.obj_id)
    calls, encode = [], Learned.encode
    monkeypatch.setattr(Learned, "encode", lambda self, *args: calls.append(0) or encode(self, *args))
    trace = trace_pose(encoded.context.stages, query, bank)
    assert len(calls) == 2  # the query and the rendered view, no template
    everything = replace(encoded.context.stages, second_look=SecondLook(hypotheses=1, block=2))
    more = trace_pose(everything, replace(query), bank).hypotheses
    assert (len(trace.hypotheses), len(more)) == (2, 4)
    best, other = trace.hypotheses
    assert (best.pair.query.shape[-1], other.pair.query.shape[-1]) == (64, 32)
    matches = sorted((len(h.matches.similarity) for h in more if h.rerendered is None), reverse=True)
    assert len(other.matches.similarity) in matches[:2]
    again = trace_pose(encoded.context.stages, replace(query), bank)
    np.testing.assert_array_equal(again.best.solution.T_cam_obj, best.solution.T_cam_obj)


def test_a_joint_fuse_is_coarsened_after_it_and_stores_nothing(scenes, cache):
    look = SecondLook(hypotheses=1, block=2)
    made = graph(scenes, cache, render=Raycast(viewpoints="superfibonacci", count=12), second_look=look)
    assert estimates(made)
    assert made.templates.encodings(1) is None


def test_the_outline_moves_the_best_pose_alone(scenes, tmp_path):
    plain, fitted = (
        estimates(graph(scenes, tmp_path, second_look=SecondLook(hypotheses=2, outline=weight)))
        for weight in (0.0, 3.0)
    )
    assert [e.template_id for e in plain] == [e.template_id for e in fitted]
    assert any(not np.array_equal(a.T_cam_obj, b.T_cam_obj) for a, b in zip(plain, fitted, strict=True))
    moved_mm = [np.linalg.norm((a.T_cam_obj - b.T_cam_obj)[:3, 3]) for a, b in zip(plain, fitted, strict=True)]
    assert np.median(moved_mm) < 10
