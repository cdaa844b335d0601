"""Two extractors concatenated, from specs and from the command line."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from command import CommandResult, run_dzop
from make_vit import write_vit

from pipeline.errors import BadInput
from pipeline.items.features import CLASS_TOKEN_LAYER
from pipeline.items.views import Crops
from pipeline.spec import Runtime, Spec, build
from pipeline.stages.extract.coordinates import Coordinates
from pipeline.stages.extract.dino import Dino
from pipeline.stages.extract.embedded import Embedded
from pipeline.stages.extract.fusion import Fusion
from pipeline.stages.extract.hog import Hog
from pipeline.stages.extract.pixels import Pixels
from pipeline.stages.extract.random_sd import RandomSD
from pipeline.synthetic.scenes import write_dataset

CPU = Runtime(device="cpu", batch=4)


def some_crops(n: int = 3, size: int = 64) -> Crops:
    rng = np.random.default_rng(0)
    mask = rng.random((n, size, size)) > 0.2
    rgb = rng.integers(0, 256, (n, size, size, 3), dtype=np.uint8) * mask[..., None]
    return Crops(rgb, mask, np.tile(np.eye(3), (n, 1, 1)))


def fusion(first: object, second: object, layers: object, **fields: object) -> Fusion:
    return build(Fusion, {"first": first, "second": second, "layers": layers} | fields, where="extract")


@pytest.mark.parametrize("alpha", [0.0, 0.3, 1.0])
def test_both_blocks_have_length_one_times_their_weight(alpha: float) -> None:
    crops = some_crops()
    spec = fusion(RandomSD(), Pixels(), [[2, 2], [11, 11]], alpha=alpha)
    maps = spec.load(CPU)(crops, [2, 11])
    for layer in (2, 11):
        c = RandomSD().feature_shape(layer)[0]
        assert tuple(maps[layer].shape[1:]) == spec.feature_shape(layer)
        ours, theirs = maps[layer][:, :c].norm(dim=1), maps[layer][:, c:].norm(dim=1)
        torch.testing.assert_close(ours, torch.full_like(ours, alpha))
        torch.testing.assert_close(theirs, torch.full_like(theirs, 1 - alpha))
    plain = RandomSD().load(CPU)(crops, [2])[2]
    torch.testing.assert_close(maps[2][:, : plain.shape[1]], alpha * torch.nn.functional.normalize(plain, dim=1))


def test_the_second_is_resampled_to_the_cells_of_the_first() -> None:
    crops = some_crops(2)
    finer, coarser = (fusion(Hog(), Pixels(), [[5, other]]).load(CPU)(crops, [5])[5] for other in (11, 2))
    for maps, layer, antialias in ((finer, 11, True), (coarser, 2, False)):
        second = Pixels().load(CPU)(crops, [layer])[layer]
        second = torch.nn.functional.interpolate(second, (16, 16), mode="bilinear", antialias=antialias)
        assert maps.shape == (2, 72 + 12, 16, 16)
        torch.testing.assert_close(maps[:, 72:], 0.5 * torch.nn.functional.normalize(second, dim=1))


def test_the_cosine_of_fused_cells_is_the_weighted_mean_of_both_cosines() -> None:
    crops = some_crops(2)
    hog, pixels = (torch.nn.functional.normalize(spec.load(CPU)(crops, [2])[2], dim=1) for spec in (Hog(), Pixels()))
    joined = fusion(Hog(), Pixels(), [[2, 2]], alpha=0.75).load(CPU)(crops, [2])[2]
    cosine = torch.cosine_similarity(joined[0], joined[1], dim=0)
    ours, theirs = ((m[0] * m[1]).sum(0) for m in (hog, pixels))
    torch.testing.assert_close(cosine, (9 * ours + theirs) / 10)


def test_cells_without_a_feature_stay_zero() -> None:
    black = Crops(np.zeros((1, 64, 64, 3), np.uint8), np.ones((1, 64, 64), bool), np.eye(3)[None])
    maps = fusion(Hog(), Hog(), [[2, 2]]).load(CPU)(black, [2])[2]
    assert not maps.any()


def test_any_two_extractors_and_a_fusion_of_fusions(tmp_path: Path) -> None:
    crops = some_crops(2)
    dino = Dino(weights=str(write_vit(tmp_path / "vit", depth=2)), input_size=64, dtype="float16")
    inner = fusion(Hog(), Embedded(), [[2, 2]])
    for first, second, pair in (
        (Hog(), Embedded(), [2, 11]),
        (dino, inner, [1, 2]),
        (inner, dino, [2, CLASS_TOKEN_LAYER]),
    ):
        spec = fusion(first, second, [pair])
        maps = spec.load(CPU)(crops, [pair[0]])[pair[0]]
        assert tuple(maps.shape[1:]) == spec.feature_shape(pair[0])
        assert maps.dtype == torch.float32


def test_features_do_not_depend_on_the_batch() -> None:
    backbone, crops = fusion(RandomSD(), Hog(), [[2, 5]]).load(CPU), some_crops(3)
    together = backbone(crops, [2])[2]
    for i in range(3):
        torch.testing.assert_close(backbone(crops[[i]], [2])[2][0], together[i], rtol=1e-5, atol=1e-5)


def test_recipe_holds_both_recipes_and_model_joins_both_names() -> None:
    spec = fusion(RandomSD(), Hog(signed=False), [[11, 5], [2, 2]])
    recipe = spec.recipe()
    assert (recipe["first"], recipe["second"]) == (RandomSD().recipe(), Hog(signed=False).recipe())
    assert recipe == fusion(RandomSD(), Hog(signed=False), [[2, 2], [11, 5]]).recipe()
    assert recipe != fusion(Hog(signed=False), RandomSD(), [[11, 5], [2, 2]]).recipe()
    assert spec.model == f"fusion-{RandomSD().model}-hog"
    assert spec.timestep == fusion(Hog(), RandomSD(), [[2, 2]]).timestep == 50
    assert spec.notice == RandomSD().notice
    assert not spec.needs_geometry
    assert fusion(Coordinates(), Hog(), [[2, 2]]).needs_geometry


class NoExtractor(Spec):
    pass


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"first": "hog"}, "extract.first: found 'hog', needs an extract variant, chosen as extract@extract.first=hog"),
        ({"second": NoExtractor()}, "extract.second: found "),
        ({"layers": [[2, 2], [2, 5]]}, "extract.layers: found ((2, 2), (2, 5)), needs each layer of the first"),
        ({"layers": []}, "extract.layers"),
        ({"layers": [[2]]}, "extract.layers.0"),
        ({"alpha": 1.5}, "extract.alpha: found 1.5"),
    ],
)
def test_a_wrong_field_is_named(fields: dict, message: str) -> None:
    with pytest.raises(BadInput) as caught:
        build(Fusion, {"first": Hog(), "second": Pixels(), "layers": [[2, 2]]} | fields, where="extract")
    assert str(caught.value).startswith(message)


def test_an_error_in_a_member_names_the_member() -> None:
    spec = fusion(Hog(), Pixels(), [[2, 2], [5, 3], [7, 2]])
    with pytest.raises(BadInput, match=r"extract layer: found 11, needs one of 2, 5, 7, as extract\.layers pairs them"):
        spec.feature_shape(11)
    with pytest.raises(BadInput, match=r"extract\.first layer: found 7, needs one of 2, 5, 8, 11"):
        spec.load(CPU)(some_crops(1), [7])
    message = r"extract\.layers: found layer 3 of the second extractor, paired with layer 5, needs one of 2, 5, 8, 11"
    with pytest.raises(BadInput, match=message):
        spec.feature_shape(5)
    with pytest.raises(BadInput, match=r"extract\.second\.weights: found './nowhere'"):
        fusion(Hog(), Dino(weights="./nowhere"), [[2, 2]]).recipe()


# --- the command line ---


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("synthetic") / "scene"
    write_dataset(root, objects=1, images=1, seed=3, size_hw=(240, 320), per_image=1, progress=False)
    return root


@pytest.fixture
def dzop(capsys, monkeypatch, tmp_path, scene):
    monkeypatch.chdir(tmp_path)
    small = (
        "method=dzop",
        "render.count=6",
        "render.size=64",
        "overlays=false",
        "runtime.progress=false",
        "runtime.device=cpu",
    )

    def run(*arguments: str) -> CommandResult:
        dataset = ("dataset=bop", "dataset.name=toy", f"dataset.root={scene}", *small)
        options = next(i for i, a in enumerate(arguments) if "=" in a)  # argparse wants options before overrides
        return run_dzop(capsys, monkeypatch, *arguments[:options], *dataset, *arguments[options:])

    return run


ANY_TWO = ("extract=fusion", "extract@extract.first=hog", "extract@extract.second=pixels", "extract.second.side=3")
LAYERS = "extract.layers=[[2,2],[5,5],[8,8],[11,8]]"


def test_the_command_line_fuses_any_two(dzop, tmp_path) -> None:
    ran = dzop(*ANY_TWO, LAYERS)
    assert ran.status == 0, ran.err
    assert "features fusion-hog-pixels" in ran.out
    config = json.loads(next(tmp_path.glob("results/*/*/poses.json")).read_text())["config"]["extract"]
    assert config["first"]["_target_"] == "pipeline.stages.extract.hog.Hog"
    assert config["second"] == {"_target_": "pipeline.stages.extract.pixels.Pixels", "side": 3}
    again = dzop(*ANY_TWO, LAYERS).counts()[0]
    assert {computed for computed, _ in again.values()} == {0}


def test_the_command_line_fuses_a_learned_model_and_a_transformer(dzop, tmp_path) -> None:
    folder = write_vit(tmp_path / "vit", depth=3)
    ran = dzop(
        "step=onboard", "extract=fusion", "extract@extract.first=embedded", "extract@extract.second=dino",
        f"extract.second.weights={folder}", "extract.second.input_size=64", "extract.layers=[[2,2],[11,1]]",
        "fuse.layers=[2,11]",
    )  # fmt: skip
    assert ran.status == 0, ran.err
    assert ran.counts()[0]["template features"] == (6, 0)


def test_the_command_line_runs_a_single_transformer(dzop, tmp_path) -> None:
    folder = write_vit(tmp_path / "vit", depth=3)
    ran = dzop(
        "extract=dino", f"extract.weights={folder}", "extract.stride=4", "extract.input_size=64", "extract.binned=[1]",
        "match.layer=2", "fuse.layers=[1]",
    )  # fmt: skip
    assert ran.status == 0, ran.err
    assert "features dino-" in ran.out


def test_a_sweep_can_vary_one_member(dzop) -> None:
    ran = dzop("-m", "step=onboard", *ANY_TWO[:2], "extract@extract.second=pixels,hog", LAYERS)
    assert ran.status == 0, ran.err
    assert "fusion-hog-pixels" in ran.out
    assert "fusion-hog-hog" in ran.out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((LAYERS, "extract.second.side=0"), "extract.second.side: found 0"),
        ((LAYERS, "extract.second._target_=nothing.Here"), "extract.second._target_"),
        (
            ("extract.layers=[[2,2],[5,3],[8,8],[11,8]]",),
            "fuse.layers: found layer 3 of the second extractor, paired with layer 5",
        ),
        (("extract.layers=[[2,2]]",), "fuse.layers: found 5, needs one of 2, as extract.layers pairs them"),
        ((LAYERS, "extract.third=1"), "extract.third"),
    ],
)
def test_an_error_is_one_line(dzop, arguments, message) -> None:
    ran = dzop(*ANY_TWO, *arguments)
    assert ran.status == 1
    lines = [line for line in ran.err.splitlines() if line]
    assert len(lines) == 1
    assert message in lines[0]
