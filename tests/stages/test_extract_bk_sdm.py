"""BK-SDM's configs (nota-ai) with small random weights, against a plain forward of diffusers."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import AutoencoderKL, UNet2DConditionModel
from make_sd15 import write_folder

from pipeline.errors import BadInput
from pipeline.items.views import Crops
from pipeline.spec import Runtime, build
from pipeline.stages.extract.bk_sdm import BkSdm
from pipeline.stages.extract.stable_diffusion import StableDiffusion

CPU = Runtime(device="cpu", batch=2)
FEWER = {"layers_per_block": 1}
TINY = {
    "mid_block_type": None,
    "block_out_channels": (32, 32, 64),
    "down_block_types": ("CrossAttnDownBlock2D",) * 3,
    "up_block_types": ("CrossAttnUpBlock2D",) * 3,
}
CONFIGS = {
    "base": (1, FEWER),
    "small": (1, FEWER | {"mid_block_type": None}),
    "tiny": (1, FEWER | TINY),
    "v2-tiny": (2, FEWER | TINY | {"attention_head_dim": [1, 1, 2]}),
}
SIZE = 128  # of the input: a latent of 16 cells


@pytest.fixture(scope="module", params=CONFIGS)
def folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    version, fields = CONFIGS[request.param]
    return write_folder(tmp_path_factory.mktemp("bk") / request.param, version=version, unet=fields)


def extractor(folder: Path, **fields: object) -> BkSdm:
    return build(BkSdm, {"weights": str(folder), "input_size": SIZE, "noise": "none"} | fields, where="extract")


def some_crops() -> Crops:
    rgb = np.random.default_rng(0).integers(0, 256, (2, SIZE, SIZE, 3), dtype=np.uint8)
    return Crops(rgb, np.ones((2, SIZE, SIZE), bool), np.tile(np.eye(3), (2, 1, 1)))


def plain_forward(folder: Path, prompt: torch.Tensor) -> dict[str, list[torch.Tensor]]:
    """By hook, the maps of all resnets of the decoder in the order in which a whole forward pass runs them."""
    unet = UNet2DConditionModel.from_pretrained(folder / "unet").eval()
    vae = AutoencoderKL.from_pretrained(folder / "vae").eval()
    maps: dict[str, list[torch.Tensor]] = {"pre": [], "resnet": []}
    for up_block in unet.up_blocks:
        for resnet in up_block.resnets:
            resnet.register_forward_pre_hook(lambda _m, inputs: maps["pre"].append(inputs[0]))
            resnet.conv2.register_forward_hook(lambda _m, _i, output: maps["resnet"].append(output))
    image = torch.from_numpy(some_crops().rgb).permute(0, 3, 1, 2) / 127.5 - 1
    with torch.no_grad():
        latent = vae.encode(image).latent_dist.mean * vae.config.scaling_factor
        unet(latent, torch.tensor(50), prompt.expand(2, -1, -1))
    return maps


def test_layers_are_the_decoders_blocks_by_position(folder: Path) -> None:
    blocks = 6 if "tiny" in folder.name else 8
    spec = extractor(folder)
    backbone = spec.load(CPU)
    plain = plain_forward(folder, backbone.model.prompt)
    assert len(plain["pre"]) == blocks
    for hook in ("pre", "resnet"):
        spec = extractor(folder, hook=hook)
        maps = spec.load(CPU)(some_crops(), range(blocks))
        for layer in range(blocks):
            channels = spec.feature_shape(layer)[0]
            assert tuple(maps[layer].shape[1:]) == spec.feature_shape(layer)
            theirs = plain[hook][layer][:, :channels]  # a block's input ends with the skip connection
            assert (maps[layer] - theirs).abs().max() <= 1e-5 * theirs.abs().max()
    with pytest.raises(BadInput, match=f"found {blocks}, needs 0..{blocks - 1}, the U-Net's {blocks} decoder blocks"):
        spec.feature_shape(blocks)


def test_the_last_block_of_each_level_has_the_cells_of_stable_diffusions(folder: Path, tmp_path: Path) -> None:
    sd = build(StableDiffusion, {"weights": str(write_folder(tmp_path / "sd")), "input_size": SIZE}, where="extract")
    ours = extractor(folder)
    pairs = {1: 5, 3: 8, 5: 11} if "tiny" in folder.name else {1: 2, 3: 5, 5: 8, 7: 11}
    for layer, theirs in pairs.items():
        assert ours.feature_shape(layer)[1:] == sd.feature_shape(theirs)[1:]


def test_the_middle_block_that_is_missing_enters_the_key(folder: Path, tmp_path: Path) -> None:
    spec = extractor(folder)
    assert spec.model.startswith("bk_sdm-")
    has_middle = json.loads((folder / "unet" / "config.json").read_text())["mid_block_type"] is not None
    assert has_middle == (folder.name == "base")
    changed = tmp_path / "changed"
    version, fields = CONFIGS[folder.name]
    other = "UNetMidBlock2DCrossAttn" if not has_middle else None
    write_folder(changed, version=version, unet=fields | {"mid_block_type": other})
    assert extractor(changed).weights_digest != spec.weights_digest
