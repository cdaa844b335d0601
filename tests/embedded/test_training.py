"""Training of the embedded model: seeded, resumable, on exact correspondences."""

import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.embedded import losses, views
from pipeline.embedded.batches import CELLS, QUERIES, TEMPLATES, Source, pair_batch, picture_batch
from pipeline.embedded.export import export
from pipeline.embedded.plan import TrainingFolder, TrainingPlan
from pipeline.embedded.surfaces import imitate_scan
from pipeline.embedded.training import iterate_batches, train
from pipeline.embedded.training_stages import Autoencoder, Denoiser, Descriptors
from pipeline.embedded.views import CLUSTERS_PER_OBJECT
from pipeline.stages.extract.embedded import digest_weights

PLAN = TrainingPlan(shards=1, autoencoder=3, denoiser=2, descriptors=2, easy=1, pictures=4, noises=2, objects=1)


@pytest.fixture(scope="module")
def shards(tmp_path_factory) -> Path:
    """One shard of two objects; made once, as the tests only read it."""
    folder = tmp_path_factory.mktemp("shards")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(views, "OBJECTS_PER_SHARD", 2)
        views.make_shard(folder, 0)
    return folder


@pytest.fixture
def folder(tmp_path, shards) -> TrainingFolder:
    (tmp_path / "shards").symlink_to(shards)
    return TrainingFolder(tmp_path)


def curve(folder: TrainingFolder, stage: str) -> list[float]:
    return [json.loads(line)["loss"] for line in folder.curve(stage).read_text().splitlines()]


def source(shards: Path) -> Source:
    return Source(shards, 1)


def test_a_batch_depends_on_its_step_alone(shards):
    first, again, other = (picture_batch(source(shards), step, count=2) for step in (3, 3, 4))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_correspondences_end_on_the_object_and_angles_are_those_of_all_templates(shards):
    batch = pair_batch(source(shards), 0, count=1)
    clusters = CLUSTERS_PER_OBJECT
    assert batch.query_xy.shape[:4] == (1, clusters, QUERIES, TEMPLATES)
    assert batch.angle_deg.shape == (1, clusters, QUERIES, clusters * TEMPLATES)
    assert batch.matched.any()
    inside = batch.mask.reshape(clusters, QUERIES + TEMPLATES, 128, 128)
    for c in range(clusters):
        for q in range(QUERIES):
            for t in range(TEMPLATES):
                ends = batch.template_xy[0, c, q, t][batch.matched[0, c, q, t]]
                px = ((ends + 0.5) * 128 / CELLS - 0.5).round().long().clamp(0, 127)
                assert inside[c, QUERIES + t, px[:, 1], px[:, 0]].float().mean() > 0.95 if len(px) else True
        own = batch.angle_deg[0, c, 0, c * TEMPLATES : (c + 1) * TEMPLATES]
        assert float(own[0]) < 10
        assert float(own.min()) == float(batch.angle_deg[0, c, 0].min())


def test_the_loss_is_low_if_cosines_peak_at_the_true_positions(shards):
    """Query cells get the random descriptors of their corresponding template cells."""
    batch = pair_batch(source(shards), 0, count=1)
    maps = torch.randn(CLUSTERS_PER_OBJECT * (QUERIES + TEMPLATES), 256, CELLS, CELLS)
    random = losses.correspondence_loss(maps, batch, torch.tensor(20.0))
    whole = batch.template_xy.clamp(0, CELLS - 1).round()
    only = replace(batch, matched=batch.matched.clone(), template_xy=whole)
    only.matched[:, :, :, 1:] = False
    only.matched[:, :, 1:] = False
    matched = maps.clone()
    for c in range(CLUSTERS_PER_OBJECT):
        first = c * (QUERIES + TEMPLATES)
        for k in torch.nonzero(only.matched[0, c, 0, 0])[:, 0]:
            x, y = only.query_xy[0, c, 0, 0, k].long()
            u, v = only.template_xy[0, c, 0, 0, k].long()
            matched[first, :, y, x] = maps[first + QUERIES, :, v, u]
    assert losses.correspondence_loss(matched, only, torch.tensor(20.0)) < random / 2


def test_a_query_scores_itself_highest_among_templates(shards):
    batch = pair_batch(source(shards), 0, count=1)
    n = QUERIES + TEMPLATES
    maps = torch.randn(CLUSTERS_PER_OBJECT * n, 16, 16, 16)
    batch.mask[:] = True
    maps[QUERIES + 2] = maps[0]
    scores = losses.retrieval_scores(maps, batch)
    assert scores.shape == batch.angle_deg.shape
    assert int(scores[0, 0, 0].argmax()) == 2
    assert float(scores[0, 0, 0, 2]) == pytest.approx(1, abs=1e-5)


def test_an_imitated_scan_differs_from_the_object_only_in_colour_and_relief(shards):
    (clusters,), rng = source(shards).objects(0, 1)
    seen = []
    for _ in range(8):
        for cluster, drawn in zip(clusters, imitate_scan(clusters, rng), strict=True):
            for view, mesh in zip(cluster, drawn, strict=True):
                assert np.array_equal(view.depth, mesh.depth)
                assert np.array_equal(view.albedo[~view.mask], mesh.albedo[~view.mask])
                lengths = np.linalg.norm(mesh.normal[view.mask], axis=-1)
                np.testing.assert_allclose(lengths, 1, atol=1e-3)
                seen.append(np.abs(view.albedo[view.mask].astype(float) - mesh.albedo[view.mask]).mean())
    assert np.median(seen) > 5


def test_batches_do_not_depend_on_the_number_of_workers(folder):
    stage = Autoencoder(PLAN, folder, 3)
    here, elsewhere = (list(iterate_batches(stage, 1, workers)) for workers in (0, 2))
    assert len(here) == len(elsewhere) == 2
    assert all(torch.equal(a, b) for a, b in zip(here, elsewhere, strict=True))


@pytest.mark.slow
def test_training_is_reproducible_and_can_be_resumed(folder, tmp_path, shards):
    torch.set_num_threads(1)
    assert train(Autoencoder(PLAN, folder, 3), folder, until=time.time() + 300)
    whole = curve(folder, "autoencoder")
    other = TrainingFolder(tmp_path / "other")
    other.folder.mkdir()
    (other.folder / "shards").symlink_to(shards)
    stage = Autoencoder(PLAN, other, 3)
    stage.steps = 2
    stage.rate_at = Autoencoder(PLAN, other, 3).rate_at  # type: ignore[method-assign]
    assert train(stage, other, until=time.time() + 300)
    assert not train(Autoencoder(PLAN, other, 3), other, until=time.time() - 1)
    assert train(Autoencoder(PLAN, other, 3), other, until=time.time() + 300)
    np.testing.assert_allclose(curve(other, "autoencoder"), whole, rtol=1e-3)


@pytest.mark.slow
def test_every_stage_starts_from_the_one_before_and_all_are_exported(folder, tmp_path):
    for kind, steps in ((Autoencoder, 1), (Denoiser, 2), (Descriptors, 2)):
        assert train(kind(PLAN, folder, steps), folder, until=time.time() + 300)
    size = export(folder, tmp_path / "weights")
    names = {path.name for path in (tmp_path / "weights").iterdir()}
    assert names == {
        "config.json",
        "losses.json",
        "vae.safetensors",
        "unet_pure.safetensors",
        "unet_learned.safetensors",
        "head.safetensors",
        "head.json",
    }
    trained_on = json.loads((tmp_path / "weights" / "head.json").read_text())
    assert trained_on["weights"] == f"learned {digest_weights(tmp_path / 'weights', 'learned')}"
    assert size < 25_000_000
    curves = json.loads((tmp_path / "weights" / "losses.json").read_text())
    assert [record["step"] for record in curves["denoiser"]] == [0, 1]
    assert curves["autoencoder"][0]["loss"] == curve(folder, "autoencoder")[0]
