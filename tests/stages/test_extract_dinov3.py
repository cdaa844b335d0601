"""DINOv3 in the published layout with small random weights, against a plain forward of transformers."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from make_vit import HEADS, REGISTERS, WIDTH, write_dinov3
from transformers import DINOv3ViTModel

from pipeline.backbones.vit.transformer import rotate_patches
from pipeline.errors import BadInput
from pipeline.items.features import CLASS_TOKEN_LAYER, SALIENCY_LAYER
from pipeline.items.views import Crops
from pipeline.spec import Runtime, build
from pipeline.stages.extract.dinov2 import DinoV2
from pipeline.stages.extract.dinov3 import DinoV3

CPU = Runtime(device="cpu", batch=4)
BLOCKS = range(3)
SIZE = 96  # 6 x 6 patches


@pytest.fixture(scope="module", params=[False, True], ids=["plain", "gated"])
def folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The MLP of S, B and L, and the gated one of S+, H+ and 7B."""
    return write_dinov3(tmp_path_factory.mktemp("dinov3") / "model", gated=request.param)


def extractor(folder: Path, **fields: object) -> DinoV3:
    return build(DinoV3, {"weights": str(folder), "input_size": SIZE, "dtype": "float32"} | fields, where="extract")


def some_crops() -> Crops:
    rgb = np.random.default_rng(0).integers(0, 256, (2, SIZE, SIZE, 3), dtype=np.uint8)
    return Crops(rgb, np.ones((2, SIZE, SIZE), bool), np.tile(np.eye(3), (2, 1, 1)))


def plain_forward(folder: Path, dtype: torch.dtype = torch.float32):
    """The outputs of transformers itself, keys as projected, and the model."""
    model = DINOv3ViTModel.from_pretrained(folder, attn_implementation="eager", dtype=dtype).eval()
    mean, std = (torch.tensor(v)[:, None, None] for v in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
    image = (torch.from_numpy(some_crops().rgb).permute(0, 3, 1, 2) / 255 - mean) / std
    keys: list[torch.Tensor] = []
    for name, module in model.named_modules():
        if name.endswith("k_proj"):
            module.register_forward_hook(lambda _m, _i, output: keys.append(output))
    with torch.no_grad():
        return model(image.to(dtype), output_hidden_states=True, output_attentions=True), keys, model


def as_map(tokens: torch.Tensor) -> torch.Tensor:
    patches = tokens[:, 1 + REGISTERS :]
    side = math.isqrt(patches.shape[1])
    return patches.transpose(1, 2).reshape(len(tokens), -1, side, side)


def assert_close(a: torch.Tensor, b: torch.Tensor, relative: float = 1e-5) -> None:
    # of the largest value: float32 sums are taken in another order by another kernel
    assert a.shape == b.shape
    assert (a - b).abs().max() <= relative * b.abs().max()


def test_every_block_equals_a_plain_forward_of_transformers(folder: Path) -> None:
    out, keys, model = plain_forward(folder)
    for fields, plain in (
        ({"norm_last": False}, [out.hidden_states[k + 1] for k in BLOCKS]),
        ({"norm_last": True}, [model.norm(out.hidden_states[k + 1]) for k in BLOCKS]),
        ({"facet": "key"}, keys),
    ):
        spec = extractor(folder, **fields)
        maps = spec.load(CPU)(some_crops(), BLOCKS)
        for layer in BLOCKS:
            assert spec.feature_shape(layer) == (WIDTH, 6, 6)
            assert_close(maps[layer], as_map(plain[layer]).detach())


def test_the_class_token_and_its_attention_are_those_of_transformers(folder: Path) -> None:
    out, _, _ = plain_forward(folder)
    maps = extractor(folder).load(CPU)(some_crops(), [SALIENCY_LAYER, CLASS_TOKEN_LAYER])
    assert_close(maps[CLASS_TOKEN_LAYER], out.last_hidden_state[:, 0, :, None, None])
    attention = as_map(out.attentions[-1][:, :, 0].mean(1)[..., None])
    least, most = (f(attention, dim=(1, 2, 3), keepdim=True) for f in (torch.amin, torch.amax))
    assert out.attentions[-1].shape[1] == HEADS
    # the softmax's values lie close together before their range is stretched to 0..1
    assert_close(maps[SALIENCY_LAYER], (attention - least) / (most - least), 1e-4)


def test_patches_keep_their_places_when_they_overlap(folder: Path) -> None:
    # No position enters block 0's keys. At stride 8 the patch of token 2i+1 begins at pixel 16i+4: it is patch i of the
    # image moved by 4 pixels.
    crops, moved = some_crops(), np.zeros_like(some_crops().rgb)
    moved[:, :-4, :-4] = crops.rgb[:, 4:, 4:]
    spec = extractor(folder, stride=8, facet="key")
    fine = spec.load(CPU)
    maps = fine(crops, [0])[0]
    plain = extractor(folder, facet="key").load(CPU)(Crops(moved, crops.mask, crops.A_crop_img), [0])[0]
    assert tuple(maps.shape[1:]) == spec.feature_shape(0) == (WIDTH, 12, 12)
    assert_close(maps[:, :, 1::2, 1::2], plain)
    # 12 x 12 tokens are placed as the patches of an image of 12 x 12 patches
    ours = rotate_patches(fine.model, torch.zeros(1, 1 + REGISTERS + 144, WIDTH), skipped=1 + REGISTERS)
    theirs = fine.model.rope_embeddings(torch.zeros(1, 3, 192, 192))
    assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))


def test_bfloat16_is_the_default_and_close_to_full_precision(folder: Path) -> None:
    default = DinoV3()
    assert default.dtype == "bfloat16"
    half = extractor(folder, dtype="bfloat16").load(CPU)
    frequencies = half.model.rope_embeddings.inv_freq
    assert frequencies.dtype == torch.float32
    maps, full = half(some_crops(), BLOCKS), extractor(folder).load(CPU)(some_crops(), BLOCKS)
    for layer in BLOCKS:
        assert maps[layer].dtype == torch.bfloat16
        cosine = torch.nn.functional.cosine_similarity(maps[layer].float(), full[layer], dim=1).mean()
        # some hundred roundings of random sign between the image and the map
        assert 1 - cosine < 100 * torch.finfo(torch.bfloat16).eps ** 2 * 100
    assert extractor(folder, dtype="bfloat16").recipe() != extractor(folder).recipe()


def test_other_classes_are_refused_in_both_directions(folder: Path, monkeypatch, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"found DINOv3ViTModel \(model_type dinov3_vit\), needs a Dinov2Model or"):
        build(DinoV2, {"weights": str(folder), "input_size": 56}, where="extract").load(CPU)
    other = tmp_path / "convnext"
    other.mkdir()
    (other / "config.json").write_text('{"model_type": "dinov3_convnext", "architectures": ["DINOv3ConvNextModel"]}')
    with pytest.raises(BadInput, match=r"found DINOv3ConvNextModel .*, needs a DINOv3ViTModel of transformers"):
        extractor(other).load(CPU)
    monkeypatch.setattr("transformers.DINOv3ViTConfig", None)
    with pytest.raises(BadInput, match="which has no DINOv3ViTConfig, needs a newer transformers"):
        extractor(folder).load(CPU)
