"""Training of the embedded model: seeded, resumable, on exact correspondences."""

import json
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.embedded import losses, views
from pipeline.embedded.batches import CELLS, QUERIES, TEMPLATES, Source, pair_batch, picture_batch
from pipeline.embedded.export import export
from pipeline.embedded.training import Autoencoder, Denoiser, Descriptors, Place, Plan, train

PLAN = Plan(shards=1, autoencoder=3, denoiser=2, descriptors=2)


@pytest.fixture(scope="module")
def shards(tmp_path_factory) -> Path:
    """One shard of two objects; made once, as all of these tests read it alone."""
    folder = tmp_path_factory.mktemp("shards")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(views, "OBJECTS_PER_SHARD", 2)
        views.make_shard(folder, 0)
    return folder


@pytest.fixture
def place(tmp_path, shards) -> Place:
    (tmp_path / "shards").symlink_to(shards)
    return Place(tmp_path)


def curve(place: Place, stage: str) -> list[float]:
    return [json.loads(line)["loss"] for line in place.curve(stage).read_text().splitlines()]


def source(shards: Path) -> Source:
    return Source(shards, 1)


def test_a_batch_depends_on_its_step_alone(shards):
    first, again, other = (picture_batch(source(shards), step, count=2) for step in (3, 3, 4))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_correspondences_are_of_one_object_point(shards):
    """Where albedo is plain the colours of both ends agree; what is checked here is geometry: ends lie on the masks."""
    batch = pair_batch(source(shards), 0, count=1)
    assert batch.query_xy.shape[:4] == (1, QUERIES, TEMPLATES, batch.matched.shape[-1])
    assert batch.matched.any()
    inside = batch.mask.reshape(1, QUERIES + TEMPLATES, 128, 128)
    for q in range(QUERIES):
        for t in range(TEMPLATES):
            ends = batch.template_xy[0, q, t][batch.matched[0, q, t]]
            px = ((ends + 0.5) * 128 / CELLS - 0.5).round().long().clamp(0, 127)
            assert inside[0, QUERIES + t, px[:, 1], px[:, 0]].float().mean() > 0.95 if len(px) else True
    assert float(batch.angle_deg.min()) < 10


def test_the_same_features_at_corresponding_cells_are_a_small_loss(shards):
    batch = pair_batch(source(shards), 0, count=1)
    n, k = QUERIES + TEMPLATES, torch.arange(CELLS * CELLS)
    place_of = torch.stack([k % CELLS, k // CELLS]).float().reshape(1, 2, CELLS, CELLS).expand(n, -1, -1, -1)
    cosine, inside = losses.correspondence_logits(torch.randn(n, 8, CELLS, CELLS), batch)
    random = losses.correspondence_loss(cosine, inside, batch, torch.tensor(10.0))
    xy = torch.stack([k % CELLS, k // CELLS], -1).float()
    exact = -(batch.template_xy[..., None, :] - xy).square().sum(-1) / 10
    assert losses.correspondence_loss(exact, inside, batch, torch.tensor(10.0)) < random / 2
    assert place_of.shape[0] == n


@pytest.mark.slow
def test_training_from_nothing_gives_the_same_losses_and_goes_on_as_if_never_stopped(place, tmp_path, shards):
    torch.set_num_threads(1)
    assert train(Autoencoder(PLAN, place, 3), place, until=time.time() + 300)
    whole = curve(place, "autoencoder")
    other = Place(tmp_path / "other")
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
def test_every_stage_stands_on_the_one_before_and_all_of_them_ship(place, tmp_path):
    for kind, steps in ((Autoencoder, 1), (Denoiser, 2), (Descriptors, 2)):
        assert train(kind(PLAN, place, steps), place, until=time.time() + 300)
    size = export(place, tmp_path / "weights")
    names = {path.name for path in (tmp_path / "weights").iterdir()}
    assert names == {
        "config.json",
        "steps.json",
        "vae.safetensors",
        "unet_pure.safetensors",
        "unet_learned.safetensors",
        "head.safetensors",
    }
    assert size < 25_000_000
