"""The model that ships with the package: its features, edges, keys and trained head."""

import json
import time

import numpy as np
import pytest
import torch

from pipeline.backbones.batching import maps_bytes
from pipeline.embedded.export import describe_features
from pipeline.errors import BadInput
from pipeline.functional.gradients import EDGES
from pipeline.items.features import CropFeatures
from pipeline.items.views import Crops
from pipeline.parallel import one_thread_per_kernel
from pipeline.spec import Runtime
from pipeline.stages.extract import embedded
from pipeline.stages.extract.embedded import FOLDER, Embedded
from pipeline.stages.fuse.auto import Auto
from pipeline.stages.fuse.learned import TRAINED_ON, Learned
from pipeline.stages.fuse.pca import Pca

LAYERS = (2, 5, 8, 11)
ALL = (*LAYERS, EDGES)


def crops(count: int) -> Crops:
    rgb = np.random.default_rng(0).integers(0, 256, (count, 128, 128, 3), dtype=np.uint8)
    return Crops(rgb, np.ones((count, 128, 128), bool), np.repeat(np.eye(3)[None], count, 0))


@pytest.mark.parametrize("weights", ["learned", "pure"])
def test_features_come_from_the_package(weights):
    extract = Embedded(weights=weights)
    maps = extract.load(Runtime(device="cpu"))(crops(2), ALL)
    for layer in ALL:
        assert maps[layer].shape[1:] == extract.feature_shape(layer)
        assert torch.isfinite(maps[layer]).all()
    assert extract.model.startswith(f"embedded-{weights}-")
    assert "not Stable Diffusion's" in extract.notice


def test_edges_do_not_depend_on_the_batch_or_the_weights():
    many = crops(5)
    whole = Embedded().load(Runtime(device="cpu", batch=2))(many, [EDGES])[EDGES]
    assert whole.shape == (5, 8, 64, 64)
    for k in range(5):
        assert torch.equal(
            Embedded(weights="pure").load(Runtime(device="cpu"))(many[k : k + 1], ALL)[EDGES][0], whole[k]
        )
    assert Embedded(input_size=256).feature_shape(EDGES) == (8, 128, 128)


def test_the_vae_encodes_small_images_in_fours_with_the_bytes_of_one():
    backbone = Embedded().load(Runtime(device="cpu"))
    rgb = np.random.default_rng(0).integers(0, 256, (6, 128, 128, 3), dtype=np.uint8)
    with one_thread_per_kernel(), torch.inference_mode():
        assert torch.equal(backbone._encode(rgb), torch.cat([backbone._encode(image[None]) for image in rgb]))


def test_edges_count_in_the_footprint():
    with_edges, without = (Embedded().footprint(layers, 128) for layers in (ALL, LAYERS))
    assert with_edges.bytes_per_crop - without.bytes_per_crop == maps_bytes([(8, 64, 64)])
    assert with_edges.weight_bytes == without.weight_bytes


def test_the_two_sets_of_weights_have_different_keys():
    keys = {json.dumps(Embedded(weights=name).recipe()) for name in ("learned", "pure")}
    assert len(keys) == 2


def test_a_template_takes_milliseconds_in_batches():
    backbone = Embedded().load(Runtime(device="cpu"))
    backbone(crops(backbone.passes.batch), LAYERS)
    times = []
    for _ in range(3):
        start = time.perf_counter()
        backbone(crops(backbone.passes.batch), LAYERS)
        times.append((time.perf_counter() - start) / backbone.passes.batch)
    # 80 ms on 2 idle cores is the promise; tests share theirs, so the fastest of three is held against five times that
    assert min(times) < 0.4


def test_missing_weights_say_how_to_make_them(tmp_path, monkeypatch):
    monkeypatch.setattr(embedded, "FOLDER", tmp_path)
    with pytest.raises(BadInput, match="make train-embedded"):
        Embedded().feature_shape(2)


def test_the_head_encodes_both_images_equally_at_twice_the_finest_layers_cells():
    maps = Embedded().load(Runtime(device="cpu"))(crops(1), ALL)
    one = CropFeatures({layer: m[0] for layer, m in maps.items()}, torch.ones(128, 128, dtype=torch.bool))
    for fuse in (Learned(), Learned(layers=LAYERS)):
        pair = fuse(one, one)
        torch.testing.assert_close(pair.query, pair.template)
        assert pair.query.shape[-1] == 2 * one.maps[11].shape[-1]


def test_edges_contribute_to_the_cosine_by_the_square_of_their_weight():
    maps = Embedded().load(Runtime(device="cpu"))(crops(2), ALL)
    mask = torch.ones(128, 128, dtype=torch.bool)
    query, template = (CropFeatures({layer: m[k] for layer, m in maps.items()}, mask) for k in (0, 1))

    def inner(fuse: Learned) -> torch.Tensor:
        pair = fuse(query, template)
        return (pair.query * pair.template).sum(0)

    alone = Learned(layers=LAYERS)(query, template)
    cosine = torch.cosine_similarity(alone.query, alone.template, dim=0)
    torch.testing.assert_close(inner(Learned(edges=2.0)) - cosine, 4 * (inner(Learned(edges=1.0)) - cosine))


def test_the_weight_of_edges_enters_the_key_only_where_edges_are_used():
    assert Learned(edges=2.0).recipe() != Learned().recipe()
    assert Learned(layers=LAYERS, edges=2.0).recipe() == Learned(layers=LAYERS).recipe()


def test_the_head_refuses_features_it_was_not_trained_on():
    Learned().check(Embedded())
    Learned().check(Embedded(dtype="float16", seed=3))
    with pytest.raises(BadInput, match=r"features of embedded-pure-.* needs extract=embedded extract.weights=learned"):
        Learned().check(Embedded(weights="pure"))
    with pytest.raises(BadInput, match=r"fuse.layers: found \[2, 5\], needs \[2, 5, 8, 11, 12\]"):
        Learned(layers=(2, 5)).check(Embedded())


@pytest.mark.parametrize(
    ("field", "value", "trained"),
    [("hook", "post", "'pre'"), ("timestep", 100, "50"), ("noise", "shared", "'none'"), ("input_size", 256, "128")],
)
def test_the_head_refuses_features_made_otherwise_than_it_was_trained(field, value, trained):
    said = rf"extract\.{field}: found {value!r}, needs {trained}, as the head of fuse=learned was trained; or fuse=pca"
    with pytest.raises(BadInput, match=said):
        Learned().check(Embedded(**{field: value}))
    with pytest.raises(BadInput, match=said):
        Auto().resolve_for(Embedded().model).check(Embedded(**{field: value}))


def test_the_head_ships_with_what_it_was_trained_on():
    assert json.loads(TRAINED_ON.read_text()) == describe_features(FOLDER)


def test_auto_uses_the_head_trained_for_the_features():
    assert Auto().resolve_for(Embedded().model) == Learned()
    with pytest.raises(BadInput, match=r"fuse.layers: found \[5, 8\]"):
        Auto(layers=(5, 8)).resolve_for(Embedded().model).check(Embedded())
    assert Auto(layers=(5, 8)).resolve_for(Embedded(weights="pure").model) == Pca(layers=(5, 8))
    assert Auto().resolve_for("hog") == Pca()
