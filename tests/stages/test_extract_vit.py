"""DINO and DINOv2 against a plain forward of transformers, on small models with random weights."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import transformers
from make_sd15 import write_folder
from make_vit import CLASS, HEADS, PATCH, REGISTERS, WIDTH, write_vit
from safetensors.torch import load_file, save_file

from pipeline.backbones.vit.features import VitFeatures
from pipeline.backbones.vit.source import VitSizes
from pipeline.backbones.vit.transformer import pad_border, resize_positions
from pipeline.errors import BadInput
from pipeline.functional import camera
from pipeline.functional.binning import log_bin
from pipeline.items.features import CLASS_FACET_LAYER, CLASS_TOKEN_LAYER, SALIENCY_LAYER, FeatureMaps
from pipeline.items.views import Crops
from pipeline.spec import Runtime, build
from pipeline.stages.extract.dino import Dino
from pipeline.stages.extract.dinov2 import DinoV2

DEPTH = 3
BLOCKS = range(DEPTH)
ALL = (*BLOCKS, SALIENCY_LAYER, CLASS_TOKEN_LAYER)
TYPES = tuple(CLASS)
CPU = Runtime(device="cpu", batch=4)
SIZE = {model_type: 8 * patch for model_type, patch in PATCH.items()}


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("vit")
    return {model_type: write_vit(root / model_type, model_type, depth=DEPTH) for model_type in TYPES}


@pytest.fixture(params=TYPES)
def folder(request: pytest.FixtureRequest, folders: dict[str, Path]) -> Path:
    return folders[request.param]


def extractor(folder: Path, **fields: object) -> VitFeatures:
    cls = Dino if json.loads((folder / "config.json").read_text())["model_type"] == "vit" else DinoV2
    size = 8 * PATCH[folder.name] if folder.name in PATCH else 64
    return build(cls, {"weights": str(folder), "input_size": size} | fields, where="extract")


def features(folder: Path, crops: Crops, layers: Sequence[int], **fields: object) -> FeatureMaps:
    return extractor(folder, **fields).load(CPU)(crops, layers)


def some_crops(n: int = 3, size: int = 64) -> Crops:
    rng = np.random.default_rng(0)
    mask = rng.random((n, size, size)) > 0.2
    rgb = rng.integers(0, 256, (n, size, size, 3), dtype=np.uint8) * mask[..., None]
    return Crops(rgb, mask, np.tile(np.eye(3), (n, 1, 1)))


def assert_close(a: torch.Tensor, b: torch.Tensor, relative: float = 1e-5) -> None:
    # of the largest value: float32 sums are taken in another order for another batch or kernel
    assert a.shape == b.shape
    assert (a - b).abs().max() <= relative * b.abs().max()


def changed(folder: Path, target: Path, **tensors: float) -> Path:
    """A copy in which some tensors are filled with a value."""
    target.mkdir()
    (target / "config.json").write_bytes((folder / "config.json").read_bytes())
    stored = load_file(folder / "model.safetensors")
    for name, value in tensors.items():
        stored[f"embeddings.{name}"].fill_(value)
    save_file(stored, target / "model.safetensors")
    return target


def plain_forward(folder: Path, crops: Crops) -> SimpleNamespace:
    """Outputs of transformers itself: tokens after every block, attentions, projections, the normalised last tokens."""
    model_type = folder.name
    cls = getattr(transformers, CLASS[model_type])
    model = cls.from_pretrained(folder, attn_implementation="eager").eval()
    image = torch.from_numpy(crops.rgb).permute(0, 3, 1, 2) / 255
    image = torch.nn.functional.interpolate(image, (SIZE[model_type],) * 2, mode="bilinear", align_corners=False)
    mean, std = (torch.tensor(v)[:, None, None] for v in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
    facets: dict[str, list[torch.Tensor]] = {"query": [], "key": [], "value": []}
    for name, module in model.named_modules():
        for facet, kept in facets.items():
            if name.rpartition(".")[2] in (facet, f"{facet[0]}_proj"):
                module.register_forward_hook(lambda _m, _i, output, kept=kept: kept.append(output))
    options = {"interpolate_pos_encoding": True} if model_type == "vit" else {}
    with torch.no_grad():
        out = model((image - mean) / std, output_hidden_states=True, output_attentions=True, **options)
        normed = [model.layernorm(tokens) for tokens in out.hidden_states]
    return SimpleNamespace(
        token=out.hidden_states[1:], normed=normed[1:], attention=out.attentions, last=out.last_hidden_state, **facets
    )


def as_map(tokens: torch.Tensor, folder: Path) -> torch.Tensor:
    patches = tokens[:, 1 + (REGISTERS if "registers" in folder.name else 0) :]
    side = math.isqrt(patches.shape[1])
    return patches.transpose(1, 2).reshape(len(tokens), -1, side, side)


@pytest.mark.parametrize("facet", ["key", "query", "value", "token"])
def test_every_block_and_facet_equals_a_plain_forward_of_transformers(folder: Path, facet: str) -> None:
    crops, plain = some_crops(), plain_forward(folder, some_crops())
    spec = extractor(folder, facet=facet, norm_last=False)
    maps = spec.load(CPU)(crops, BLOCKS)
    for layer in BLOCKS:
        assert tuple(maps[layer].shape[1:]) == spec.feature_shape(layer) == (WIDTH, 8, 8)
        assert_close(maps[layer], as_map(getattr(plain, facet)[layer], folder))


def test_the_last_norm_is_applied_to_tokens_of_any_block_only(folder: Path) -> None:
    crops, plain = some_crops(), plain_forward(folder, some_crops())
    maps = features(folder, crops, BLOCKS, facet="token", norm_last=True)
    for layer in BLOCKS:
        assert_close(maps[layer], as_map(plain.normed[layer], folder))
    assert_close(maps[DEPTH - 1], as_map(plain.last, folder))
    keys = [features(folder, crops, [1], facet="key", norm_last=norm_last)[1] for norm_last in (True, False)]
    assert torch.equal(*keys)
    recipes = [extractor(folder, facet="key", norm_last=norm_last).recipe() for norm_last in (True, False)]
    assert recipes[0] == recipes[1]


def test_saliency_is_the_class_tokens_attention_as_transformers_has_it(folder: Path) -> None:
    crops, plain = some_crops(), plain_forward(folder, some_crops())
    for heads in ([0, 2, 4, 5], [3], None):
        ours = features(folder, crops, [SALIENCY_LAYER], saliency_heads=heads)[SALIENCY_LAYER]
        chosen = list(range(HEADS)) if heads is None else heads
        theirs = as_map(plain.attention[-1][:, chosen, 0].mean(1)[..., None], folder)
        least, most = (f(theirs, dim=(1, 2, 3), keepdim=True) for f in (torch.amin, torch.amax))
        assert ours.shape == (3, 1, 8, 8)
        assert (ours.amin((1, 2, 3)) == 0).all()
        assert (ours.amax((1, 2, 3)) == 1).all()
        # the softmax's values lie close together before their range is stretched to 0..1
        assert_close(ours, (theirs - least) / (most - least), 1e-4)


def test_saliency_of_one_colour_is_finite(folders: dict[str, Path], tmp_path: Path) -> None:
    folder = changed(folders["vit"], tmp_path / "flat", position_embeddings=0.0)
    grey = Crops(np.full((1, 64, 64, 3), 90, np.uint8), np.ones((1, 64, 64), bool), np.eye(3)[None])
    assert torch.isfinite(features(folder, grey, [SALIENCY_LAYER])[SALIENCY_LAYER]).all()


def test_the_class_token_is_the_first_of_the_last_hidden_state(folder: Path) -> None:
    crops, plain = some_crops(), plain_forward(folder, some_crops())
    for fields in ({}, {"facet": "key"}, {"facet": "token", "norm_last": False}):
        ours = features(folder, crops, [CLASS_TOKEN_LAYER, 0], **fields)[CLASS_TOKEN_LAYER]
        assert_close(ours, plain.last[:, 0, :, None, None])


@pytest.mark.parametrize("facet", ["key", "query", "value"])
def test_the_class_tokens_facet_is_that_of_the_last_block(folder: Path, facet: str) -> None:
    crops, plain = some_crops(), plain_forward(folder, some_crops())
    spec = extractor(folder, facet=facet)
    for layers in ([CLASS_FACET_LAYER], [0, CLASS_FACET_LAYER, CLASS_TOKEN_LAYER, SALIENCY_LAYER]):
        ours = spec.load(CPU)(crops, layers)[CLASS_FACET_LAYER]
        assert tuple(ours.shape[1:]) == spec.feature_shape(CLASS_FACET_LAYER)
        assert_close(ours, getattr(plain, facet)[-1][:, 0, :, None, None])
    with pytest.raises(BadInput, match=r"extract\.facet: found token, needs key, query or value, for layer -3"):
        extractor(folder, facet="token").feature_shape(CLASS_FACET_LAYER)


def test_local_layers_are_those_of_a_smaller_input(folders: dict[str, Path]) -> None:
    folder, crops, layers = folders["vit"], some_crops(), (2, SALIENCY_LAYER, 1, CLASS_FACET_LAYER)
    both = extractor(folder, binned=[1], stride=4, input_size=64, local_size=24)
    ours = both.load(CPU)(crops, layers)
    assert list(ours) == list(layers)
    for size, of_size in ((24, (1, SALIENCY_LAYER)), (64, (2, CLASS_FACET_LAYER))):
        alone = features(folder, crops, of_size, binned=[1], stride=4, input_size=size)
        for layer in of_size:
            assert torch.equal(ours[layer], alone[layer])
            assert tuple(ours[layer].shape[1:]) == both.feature_shape(layer)
    plain = extractor(folder, binned=[1], stride=4, input_size=64)
    assert "local_size" not in plain.recipe()
    assert both.recipe()["local_size"] == 24
    assert refusal(folder, local_size=30) == "extract.local_size: found 30, needs a multiple of the stride 8"


def test_overlapping_patches_equal_plain_ones_of_the_shifted_image(folders: dict[str, Path], tmp_path: Path) -> None:
    # Without positions, what enters block 0, and so its keys, depends on each token's own patch alone. At stride 4
    # patch (2i+1, 2j+1) begins at pixel (8i+2, 8j+2): it is patch (i, j) of the image moved by 2 pixels up and left.
    folder = changed(folders["vit"], tmp_path / "vit", position_embeddings=0.0)
    crops = some_crops()
    moved = np.zeros_like(crops.rgb)
    moved[:, :-2, :-2] = crops.rgb[:, 2:, 2:]
    for facet in ("key", "value"):
        fine = features(folder, crops, [0], stride=4, facet=facet)[0]
        plain = features(folder, Crops(moved, crops.mask, crops.A_crop_img), [0], facet=facet)[0]
        assert fine.shape == (3, WIDTH, 16, 16)
        assert_close(fine[:, :, 1::2, 1::2], plain)


@pytest.mark.parametrize(("model_type", "stride"), [("vit", s) for s in (8, 4, 2, 1)] + [("dinov2", 7), ("dinov2", 14)])
def test_a_token_is_centred_on_its_cell(folders: dict[str, Path], tmp_path: Path, model_type: str, stride: int) -> None:
    # a kernel that averages its patch sees, in an image that brightens evenly, the brightness at the patch's centre
    size, cells = SIZE[model_type], SIZE[model_type] // stride
    ramp = np.broadcast_to(np.arange(size, dtype=np.float32), (1, 3, size, size)).copy()
    patch = PATCH[model_type]
    seen = torch.nn.functional.avg_pool2d(
        pad_border(torch.from_numpy(ramp), overhang=patch - stride), patch, stride=stride
    )[0, 0, cells // 2]
    assert seen.shape == (cells,)
    centre = camera.cell_to_px(torch.stack([torch.arange(cells)] * 2, 1).double(), size=size, cells=cells)[:, 0]
    inside = (centre > patch) & (centre < size - 1 - patch) if stride < patch else torch.ones(cells, dtype=torch.bool)
    torch.testing.assert_close(seen[inside].double(), centre[inside], rtol=1e-5, atol=1e-3)


def test_positions_follow_the_cells_when_patches_overlap(folders: dict[str, Path]) -> None:
    # twice as many cells: positions interpolated to them, as transformers does for an image twice as large
    folder, crops = folders["vit"], some_crops()
    model = transformers.ViTModel.from_pretrained(folder)
    ours = resize_positions(model.embeddings.position_embeddings[:, 1:], cells=16, antialias=False)
    theirs = model.embeddings.interpolate_pos_encoding(torch.empty(1, 1 + 16 * 16, WIDTH), 128, 128)[:, 1:]
    assert_close(ours.detach(), theirs.detach())
    assert features(folder, crops, [2], stride=4)[2].shape == (3, WIDTH, 16, 16)


def test_binned_layers_hold_the_bins_of_the_plain_ones(folder: Path) -> None:
    crops = some_crops(2)
    plain = features(folder, crops, [0, 1])
    spec = extractor(folder, binned=[1])
    maps = spec.load(CPU)(crops, [0, 1])
    assert torch.equal(maps[0], plain[0])
    assert_close(maps[1], log_bin(plain[1], hierarchy=2))
    assert spec.feature_shape(1) == (17 * WIDTH, 8, 8) == tuple(maps[1].shape[1:])
    assert extractor(folder, binned=[1], hierarchy=1).feature_shape(1) == (9 * WIDTH, 8, 8)


@pytest.mark.parametrize("stride", [None, 2])
def test_features_do_not_depend_on_the_batch(folder: Path, stride: int | None) -> None:
    crops = some_crops(4)
    backbone = extractor(folder, stride=stride, binned=[1]).load(CPU)
    together = backbone(crops, ALL)
    for i in range(4):
        alone = backbone(crops[[i]], ALL)
        for layer in ALL:
            assert_close(alone[layer][0], together[layer][i], 1e-4 if layer == SALIENCY_LAYER else 1e-5)
    again = backbone(crops, ALL)
    assert all(again[layer].numpy().tobytes() == together[layer].numpy().tobytes() for layer in ALL)


@pytest.mark.parametrize(
    ("facet", "layers", "blocks", "last_part"),
    [
        ("token", [0, 1], 2, None),
        ("key", [1, 0], 1, ("key", "k_proj")),
        ("value", [2], 2, ("value", "v_proj")),
        ("key", [SALIENCY_LAYER, 0], 2, ("key", "k_proj")),
        ("key", [CLASS_TOKEN_LAYER], 3, ("layernorm",)),
        ("token", [], 0, None),
    ],
)
def test_nothing_is_computed_past_the_deepest_block(
    folder: Path, facet: str, layers: list[int], blocks: int, last_part: tuple[str, ...] | None
) -> None:
    backbone = extractor(folder, facet=facet, norm_last=False).load(CPU)
    calls: list[str] = []
    for name, module in backbone.model.named_modules():
        module.register_forward_pre_hook(lambda _m, _i, name=name: calls.append(name))
    backbone(some_crops(1), layers)
    whole = [name for name in calls if name.rpartition(".")[2] == "mlp" or name.endswith("intermediate")]
    assert len(whole) == blocks
    if last_part is not None:
        assert calls[-1].rpartition(".")[2] in last_part


def test_the_order_of_layers_and_their_number_do_not_matter(folder: Path) -> None:
    backbone, crops = extractor(folder).load(CPU), some_crops(2)
    asked = backbone(crops, [2, SALIENCY_LAYER, 0, 0])
    assert list(asked) == [2, SALIENCY_LAYER, 0]
    assert_close(asked[0], backbone(crops, [0])[0])
    assert backbone(crops, []) == {}


def test_features_are_ordinary_tensors_that_may_be_changed(folder: Path) -> None:
    for maps in features(folder, some_crops(1), ALL).values():
        maps.div_(2)
        assert not maps.is_inference()
        assert not maps.requires_grad


@pytest.mark.parametrize("dtype", ["float16", "bfloat16"])
def test_half_precision_is_close_to_full(folder: Path, dtype: str) -> None:
    crops, layers = some_crops(2), (*BLOCKS, CLASS_TOKEN_LAYER)
    full, half = (features(folder, crops, layers, dtype=d, binned=[1]) for d in ("float32", dtype))
    for layer in layers:
        assert half[layer].dtype == getattr(torch, dtype)
        cosine = torch.nn.functional.cosine_similarity(half[layer].float(), full[layer], dim=1).mean()
        # some hundred roundings of random sign between the image and the map
        assert 1 - cosine < 100 * torch.finfo(getattr(torch, dtype)).eps


def test_what_save_pretrained_writes_gives_the_same_features(folder: Path, tmp_path: Path) -> None:
    cls = getattr(transformers, CLASS[folder.name])
    saved = tmp_path / folder.name
    cls.from_pretrained(folder).save_pretrained(saved, max_shard_size="100KB")
    assert len(list(saved.glob("*.safetensors"))) > 1
    crops = some_crops(2)
    ours, theirs = (features(path, crops, ALL) for path in (saved, folder))
    assert all(torch.equal(ours[layer], theirs[layer]) for layer in ALL)
    assert extractor(saved).recipe() != extractor(folder).recipe()


def test_the_gated_mlp_of_dinov2_giant_is_loaded(tmp_path: Path) -> None:
    torch.manual_seed(0)
    sizes = {"hidden_size": 48, "num_hidden_layers": 2, "num_attention_heads": 6, "image_size": 56, "patch_size": 14}
    model = transformers.Dinov2Model(transformers.Dinov2Config(**sizes, mlp_ratio=2, use_swiglu_ffn=True)).eval()
    model.save_pretrained(tmp_path / "giant")
    maps = features(tmp_path / "giant", some_crops(1), [1], input_size=56)
    assert maps[1].shape == (1, 48, 4, 4)


def test_the_key_depends_on_the_bytes_and_not_the_path(folder: Path, tmp_path: Path) -> None:
    copy = changed(folder, tmp_path / folder.name)
    here, there = extractor(folder), extractor(copy, revision="main", stride=PATCH[folder.name])
    assert here.recipe() == there.recipe()
    assert here.model == there.model == f"{here.kind.removeprefix('extract.')}-{here.recipe()['weights'][:8]}"
    assert str(tmp_path) not in json.dumps(there.recipe())
    other = changed(folder, tmp_path / "other", cls_token=0.5)
    assert extractor(other).recipe() != here.recipe()
    (copy / "pytorch_model.bin").write_bytes(b"never opened")
    assert extractor(copy).recipe() == here.recipe()


def test_the_default_shapes_are_those_of_the_published_models() -> None:
    def shaped(spec: VitFeatures, sizes: VitSizes) -> VitFeatures:
        spec.__dict__["sizes"] = sizes
        return spec

    vits8 = VitSizes(width=384, depth=12, heads=6, patch=8, registers=0)
    assert shaped(Dino(), vits8).feature_shape(11) == (384, 28, 28)
    zs6d = shaped(Dino(stride=4, binned=(9,)), vits8)
    assert [zs6d.feature_shape(layer) for layer in (11, 9, SALIENCY_LAYER)] == [
        (384, 56, 56),
        (6528, 56, 56),
        (1, 56, 56),
    ]
    large = shaped(DinoV2(), VitSizes(width=1024, depth=24, heads=16, patch=14, registers=4))
    assert large.feature_shape(18) == (1024, 30, 30)
    assert large.feature_shape(CLASS_TOKEN_LAYER) == (1024, 1, 1)


def refusal(weights: object, cls: type[VitFeatures] = Dino, **fields: object) -> str:
    with pytest.raises(BadInput) as caught:
        build(cls, {"weights": str(weights), "input_size": 56} | fields, where="extract").load(CPU)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_layer_stride_or_size_the_model_does_not_have_is_named(folders: dict[str, Path]) -> None:
    dino, dinov2 = folders["vit"], folders["dinov2"]
    with pytest.raises(BadInput, match=r"extract layer: found 3, needs 0\.\.2, the transformer's 3 blocks, -1"):
        extractor(dino).feature_shape(3)
    with pytest.raises(BadInput, match=r"extract layer: found -4, needs 0\.\.2"):
        extractor(dino).load(CPU)(some_crops(1), [0, -4])
    assert refusal(dino, stride=3) == "extract.stride: found 3, needs a divisor of the patch size 8: 1, 2, 4, 8"
    assert refusal(dinov2, DinoV2, stride=28) == (
        "extract.stride: found 28, needs a divisor of the patch size 14: 1, 2, 7, 14"
    )
    assert refusal(dino, input_size=100) == "extract.input_size: found 100, needs a multiple of the stride 8"
    assert refusal(dino, binned=[1, 9]) == "extract.binned: found 9, needs 0..2, the transformer's 3 blocks"
    assert "extract.facet: found 'keys'" in refusal(dino, facet="keys")
    assert "extract.hierarchy: found 0" in refusal(dino, hierarchy=0)
    for heads in ([0, 6], []):
        with pytest.raises(BadInput, match=r"extract\.saliency_heads: found .*, needs some of 0\.\.5"):
            extractor(dino, saliency_heads=heads).feature_shape(SALIENCY_LAYER)
    assert extractor(dino, saliency_heads=[6]).feature_shape(0) == (WIDTH, 8, 8)


def test_weights_of_another_class_are_refused(folders: dict[str, Path], tmp_path: Path) -> None:
    assert refusal(folders["dinov2"]).endswith(
        "config.json: found Dinov2Model (model_type dinov2), needs a ViTModel of transformers"
    )
    needed = "needs a Dinov2Model or Dinov2WithRegistersModel of transformers"
    assert refusal(folders["vit"], DinoV2).endswith(f"config.json: found ViTModel (model_type vit), {needed}")
    transformers.ResNetModel(
        transformers.ResNetConfig(embedding_size=8, hidden_sizes=[8], depths=[1], layer_type="basic")
    ).save_pretrained(tmp_path / "resnet")
    for cls in (Dino, DinoV2):
        assert "config.json: found ResNetModel (model_type resnet)" in refusal(tmp_path / "resnet", cls)
    write_folder(tmp_path / "sd")
    message = refusal(tmp_path / "sd")
    assert "config.json: found no such file (scheduler, text_encoder, tokenizer, unet, vae), needs a ViT" in message
    assert "config.json: found CLIPTextModel (model_type clip_text_model)" in refusal(tmp_path / "sd" / "text_encoder")
    assert "config.json: found UNet2DConditionModel (model_type None)" in refusal(tmp_path / "sd" / "unet")
    classifier = tmp_path / "classifier"
    write_vit(classifier, depth=1)
    edit(classifier, architectures=["ViTForImageClassification"])
    assert "found ViTForImageClassification (model_type vit)" in refusal(classifier)


def edit(folder: Path, **fields: object) -> None:
    path = folder / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))


def test_a_folder_without_safetensors_is_named(tmp_path: Path) -> None:
    missing = refusal(tmp_path / "nowhere")
    assert missing.startswith(f"extract.weights: found '{tmp_path}/nowhere', which is not there, needs a folder")
    (tmp_path / "empty").mkdir()
    assert "config.json: found no such file (an empty folder)" in refusal(tmp_path / "empty")
    folder = write_vit(tmp_path / "vit", depth=1)
    assert "which is a file" in refusal(folder / "model.safetensors")
    (folder / "model.safetensors").rename(folder / "kept")
    assert "model.safetensors: found no such file, needs the weights" in refusal(folder)
    (folder / "pytorch_model.bin").write_bytes(b"never opened")
    assert "model.safetensors: found only pytorch_model.bin, needs safetensors" in refusal(folder)


def test_weights_that_are_truncated_or_do_not_fit_are_named(tmp_path: Path) -> None:
    folder = write_vit(tmp_path / "vit", depth=2)
    whole = (folder / "model.safetensors").read_bytes()
    (folder / "model.safetensors").write_bytes(whole[: len(whole) // 2])
    assert "needs a complete safetensors file" in refusal(folder)
    (folder / "model.safetensors").write_bytes(whole)
    edit(folder, num_hidden_layers=3)
    assert "missing), needs all weights" in refusal(folder)
    edit(folder, num_hidden_layers=2, intermediate_size=200)
    assert "tensor layers.0" in (message := refusal(folder)) or "tensor encoder.layer.0" in message
    assert "found (96,), needs (200,), as config.json says" in message
    edit(folder, patch_size=[8, 8])
    assert "config.json: found patch_size [8, 8], needs a whole number from 1 to 16384" in refusal(folder)
    edit(folder, hidden_size="wide")
    assert "config.json: found" in refusal(folder)
    (folder / "config.json").write_text("{")
    assert "needs valid JSON" in refusal(folder)


def test_an_unreachable_hub_id_says_what_to_do(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    for cls in (Dino, DinoV2):
        with pytest.raises(BadInput) as caught:
            cls().feature_shape(0)
        assert str(caught.value).startswith(f"extract.weights: found '{cls().weights}', which is not a local path")
        assert "or its local folder, downloaded elsewhere" in str(caught.value)
