"""CleanDIFT's files as published (the U-Net's state dict in bfloat16) with small random weights."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import AutoencoderKL, UNet2DConditionModel
from make_sd15 import write_folder
from safetensors.torch import load_file, save_file

from pipeline.errors import BadInput
from pipeline.items.views import Crops
from pipeline.spec import Runtime, build
from pipeline.stages.extract.cleandift import CleanDift
from pipeline.stages.extract.stable_diffusion import StableDiffusion

CPU = Runtime(device="cpu", batch=2)
LAYERS = (2, 5, 8, 11)
SIZE = 64
FILES = {1: "cleandift_sd15_unet.safetensors", 2: "cleandift_sd21_unet.safetensors"}


@pytest.fixture(scope="module")
def bases(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    root = tmp_path_factory.mktemp("bases")
    return {version: write_folder(root / f"sd{version}", version=version) for version in FILES}


@pytest.fixture(scope="module")
def published(bases: dict[int, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with both files; their weights are those of the base, scaled."""
    root = tmp_path_factory.mktemp("cleandift")
    for version, base in bases.items():
        unet = load_file(base / "unet" / "diffusion_pytorch_model.safetensors")
        save_file({name: (0.9 * value).bfloat16() for name, value in unet.items()}, root / FILES[version])
    return root


def extractor(base: Path, unet: Path, **fields: object) -> CleanDift:
    given = {"weights": str(base), "unet": str(unet), "input_size": SIZE} | fields
    return build(CleanDift, given, where="extract")


def some_crops() -> Crops:
    rgb = np.random.default_rng(0).integers(0, 256, (2, SIZE, SIZE, 3), dtype=np.uint8)
    return Crops(rgb, np.ones((2, SIZE, SIZE), bool), np.tile(np.eye(3), (2, 1, 1)))


def refusal(base: Path, unet: object, **fields: object) -> str:
    with pytest.raises(BadInput) as caught:
        extractor(base, Path(str(unet)), **fields).load(CPU)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("version", FILES)
def test_features_are_those_of_the_published_use(bases: dict[int, Path], published: Path, version: int) -> None:
    """The model card's: load_state_dict of the file into the base's U-Net; the clean latent at timestep 261."""
    backbone = extractor(bases[version], published).load(CPU)
    unet = UNet2DConditionModel.from_pretrained(bases[version] / "unet").eval()
    unet.load_state_dict(load_file(published / FILES[version]), strict=True)
    vae = AutoencoderKL.from_pretrained(bases[version] / "vae").eval()
    entered: list[torch.Tensor] = []
    for up_block in unet.up_blocks:
        for resnet in up_block.resnets:
            resnet.register_forward_pre_hook(lambda _m, inputs: entered.append(inputs[0]))
    image = torch.from_numpy(some_crops().rgb).permute(0, 3, 1, 2) / 127.5 - 1
    with torch.no_grad():
        latent = vae.encode(image).latent_dist.mean * vae.config.scaling_factor
        unet(latent, torch.tensor(261), backbone.model.prompt.expand(2, -1, -1))
    maps = backbone(some_crops(), LAYERS)
    for layer in LAYERS:
        theirs = entered[layer][:, : maps[layer].shape[1]]  # a block's input ends with the skip connection
        # float32 sums are taken in another order for another blocking
        assert (maps[layer] - theirs).abs().max() <= 1e-5 * theirs.abs().max()


def test_folder_and_file_have_one_key_that_depends_on_the_unet_alone(bases, published: Path, tmp_path: Path) -> None:
    whole = extractor(bases[1], published)
    assert extractor(bases[1], published / FILES[1]).recipe() == whole.recipe()
    assert whole.model.startswith("cleandift-")
    assert str(published) not in str(whole.recipe())
    other = Path(shutil.copytree(bases[1], tmp_path / "other"))  # the base's own U-Net is not read
    (other / "unet" / "diffusion_pytorch_model.safetensors").write_bytes(b"broken")
    assert extractor(other, published).recipe() == whole.recipe()
    tensors = load_file(published / FILES[1])
    name = "up_blocks.3.resnets.2.conv2.bias"
    save_file(tensors | {name: tensors[name] + 1}, tmp_path / FILES[1])
    assert extractor(bases[1], tmp_path).recipe()["weights"] != whole.recipe()["weights"]
    sd = build(StableDiffusion, {"weights": str(bases[1])}, where="extract")
    assert sd.recipe()["weights"] != whole.recipe()["weights"]


def test_other_files_are_refused_with_file_and_tensor(bases, published: Path, tmp_path: Path) -> None:
    mixed = refusal(bases[1], published / FILES[2])
    assert mixed.startswith(str(published / FILES[2]))
    assert "is it of another Stable Diffusion?" in mixed
    tensors = load_file(published / FILES[1])
    full = {f"unet_feature_extractor_gfe.{name}": value for name, value in tensors.items()}
    save_file(full | {"timestep": torch.tensor(261.0)}, tmp_path / "cleandift_sd15_full.safetensors")
    assert re.search(
        r"full\.safetensors: found a tensor (timestep|unet_feature_extractor_gfe\.\S+), needs only those of the U-Net",
        refusal(bases[1], tmp_path / "cleandift_sd15_full.safetensors"),
    )
    tensors.pop("conv_in.bias")
    save_file(tensors, tmp_path / "cut.safetensors")
    assert "no tensor for conv_in.bias (1 missing)" in refusal(bases[1], tmp_path / "cut.safetensors")


def test_a_missing_file_and_noise_are_refused(bases, published: Path, tmp_path: Path, monkeypatch) -> None:
    message = refusal(bases[1], tmp_path)
    assert message.startswith("extract.unet: found")
    assert FILES[1] in message
    assert "weights.cleandift=FOLDER" in message
    assert "which is not there" in refusal(bases[1], tmp_path / "x.safetensors")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    assert "extract.unet: found 'someone/else', which is not a local path" in refusal(bases[1], "someone/else")
    assert "noise" in refusal(bases[1], published, noise="shared")
