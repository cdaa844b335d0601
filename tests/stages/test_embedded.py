"""The model that ships: from the package, without a network, with its own head."""

import json
import time

import numpy as np
import pytest
import torch

from pipeline.errors import BadInput
from pipeline.items.views import Crops
from pipeline.spec import Runtime
from pipeline.stages.extract import embedded
from pipeline.stages.extract.embedded import Embedded
from pipeline.stages.fuse.auto import Auto
from pipeline.stages.fuse.learned import Learned
from pipeline.stages.fuse.pca import Pca

LAYERS = (2, 5, 8, 11)


def crops(count: int) -> Crops:
    rgb = np.random.default_rng(0).integers(0, 256, (count, 128, 128, 3), dtype=np.uint8)
    return Crops(rgb, np.ones((count, 128, 128), bool), np.repeat(np.eye(3)[None], count, 0))


@pytest.mark.parametrize("weights", ["learned", "pure"])
def test_features_come_from_the_package(weights):
    extract = Embedded(weights=weights)
    maps = extract.load(Runtime(device="cpu"))(crops(2), LAYERS)
    for layer in LAYERS:
        assert maps[layer].shape[1:] == extract.feature_shape(layer)
        assert torch.isfinite(maps[layer]).all()
    assert extract.model.startswith(f"embedded-{weights}-")
    assert "not Stable Diffusion's" in extract.notice


def test_the_two_sets_of_weights_have_keys_of_their_own():
    keys = {json.dumps(Embedded(weights=name).recipe()) for name in ("learned", "pure")}
    assert len(keys) == 2


def test_a_template_takes_milliseconds_in_batches():
    backbone = Embedded().load(Runtime(device="cpu"))
    backbone(crops(backbone.batch), LAYERS)
    times = []
    for _ in range(3):
        start = time.perf_counter()
        backbone(crops(backbone.batch), LAYERS)
        times.append((time.perf_counter() - start) / backbone.batch)
    # 80 ms on 2 idle cores is the promise; tests share theirs, so the fastest of three is held against five times that
    assert min(times) < 0.4


def test_missing_weights_say_how_to_make_them(tmp_path, monkeypatch):
    embedded.shipped_config.cache_clear()
    monkeypatch.setattr(embedded, "FOLDER", tmp_path)
    with pytest.raises(BadInput, match="make train-embedded"):
        Embedded().feature_shape(2)
    embedded.shipped_config.cache_clear()


def test_the_head_fuses_both_sides_alike_at_twice_the_finest_layers_cells():
    maps = Embedded().load(Runtime(device="cpu"))(crops(1), LAYERS)
    one = {layer: m[0] for layer, m in maps.items()}
    mask = torch.ones(128, 128, dtype=torch.bool)
    pair = Learned()(one, one, mask, mask)
    torch.testing.assert_close(pair.query, pair.template)
    assert pair.query.shape[-1] == 2 * one[11].shape[-1]


def test_the_head_refuses_features_it_was_not_trained_on():
    Learned().check(Embedded().model)
    with pytest.raises(BadInput, match=r"features of embedded-pure-.* needs extract=embedded extract.weights=learned"):
        Learned().check(Embedded(weights="pure").model)
    with pytest.raises(BadInput, match=r"fuse.layers: found \[2, 5\], needs \[2, 5, 8, 11\]"):
        Learned(layers=(2, 5)).check(Embedded().model)


def test_auto_takes_the_head_where_the_features_have_one():
    assert Auto().resolve_for(Embedded().model) == Learned()
    assert Auto(layers=(5, 8)).resolve_for(Embedded(weights="pure").model) == Pca(layers=(5, 8))
    assert Auto().resolve_for("hog") == Pca()
