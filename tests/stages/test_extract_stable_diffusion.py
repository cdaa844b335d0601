"""Features of Stable Diffusion against a plain forward of diffusers, on a small model with random weights."""

import subprocess
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
from make_sd15 import unet_config, write_folder
from transformers import CLIPTextModel

from pipeline.backbones.stable_diffusion.decoder import map_shape, read_decoder_maps
from pipeline.backbones.stable_diffusion.features import DiffusionBackbone
from pipeline.errors import BadInput
from pipeline.items.features import FeatureMaps
from pipeline.items.views import Crops
from pipeline.parallel import worker_count
from pipeline.spec import Runtime, build
from pipeline.stages.extract.stable_diffusion import StableDiffusion

LAYERS = range(12)
PAPER_LAYERS = (2, 5, 8, 11)
HOOKS = ("pre", "post", "resnet")
CPU = Runtime(device="cpu", batch=4)


@pytest.fixture(scope="module", params=[1, 2], ids=["sd1", "sd2"])
def folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """SD 1.x: 8 heads, projections as kernels. SD 2.x: heads by level, linear projections, OpenCLIP's padding."""
    return write_folder(tmp_path_factory.mktemp("sd") / f"sd{request.param}", version=request.param)


@pytest.fixture(scope="module")
def sd1(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_folder(tmp_path_factory.mktemp("sd") / "sd1")


def extractor(folder: Path, **fields: object) -> StableDiffusion:
    return build(StableDiffusion, {"weights": str(folder), "input_size": 128} | fields, where="extract")


@cache
def loaded(folder: Path, dtype: str = "float32", prompt: str = "") -> DiffusionBackbone:
    """One model for the tests that change only how it is used."""
    return extractor(folder, dtype=dtype, prompt=prompt).load(CPU)


def features(folder: Path, crops: Crops, layers: Sequence[int], **fields: object) -> FeatureMaps:
    spec = extractor(folder, **fields)
    base = loaded(folder, spec.dtype, spec.prompt)
    return DiffusionBackbone(spec, base.configs, base.model, base.passes)(crops, layers)


def some_crops(n: int = 4, size: int = 64) -> Crops:
    rng = np.random.default_rng(0)
    mask = rng.random((n, size, size)) > 0.3
    rgb = rng.integers(0, 256, (n, size, size, 3), dtype=np.uint8) * mask[..., None]
    return Crops(rgb, mask, np.tile(np.eye(3), (n, 1, 1)))


def assert_close(a: torch.Tensor, b: torch.Tensor, relative: float = 1e-5) -> None:
    # of the largest value: float32 sums are taken in another order for another batch or blocking
    assert (a - b).abs().max() <= relative * b.abs().max()


def plain_forward(folder: Path, crops: Crops, *, timestep: int, noise: torch.Tensor) -> dict[str, list[torch.Tensor]]:
    """Maps of all 12 blocks for all hooks, read from the inputs and outputs of resnets in one full forward pass."""
    unet = UNet2DConditionModel.from_pretrained(folder / "unet").eval()
    vae = AutoencoderKL.from_pretrained(folder / "vae").eval()
    encoder = CLIPTextModel.from_pretrained(folder / "text_encoder").eval()
    padding = 0 if unet.config.use_linear_projection else 49407
    entered: list[torch.Tensor] = []
    branch: list[torch.Tensor] = []

    def listen(resnet, inputs, output):
        shortcut = resnet.conv_shortcut(inputs[0]) if resnet.conv_shortcut is not None else inputs[0]
        entered.append(inputs[0])
        branch.append(output - shortcut)

    for up_block in unet.up_blocks:
        for resnet in up_block.resnets:
            resnet.register_forward_hook(listen)
    unet.conv_norm_out.register_forward_hook(lambda _m, inputs, _o: entered.append(inputs[0]))
    with torch.no_grad():
        image = torch.from_numpy(crops.rgb).permute(0, 3, 1, 2) / 127.5 - 1
        image = torch.nn.functional.interpolate(image, (128, 128), mode="bilinear", align_corners=False)
        latent = vae.encode(image).latent_dist.mode() * vae.config.scaling_factor
        scheduler = DDIMScheduler.from_pretrained(folder / "scheduler")
        latent = scheduler.add_noise(latent, noise.expand_as(latent), torch.tensor([timestep] * len(latent)))
        prompt = encoder(torch.tensor([[49406, 49407] + [padding] * 75])).last_hidden_state
        unet(latent, timestep, prompt.expand(len(latent), -1, -1))
    # the skip is concatenated last
    widths = [map_shape(unet.config, layer=k, hook="pre", latent_size=16)[0] for k in LAYERS]
    carried = [x[:, : [*widths, x.shape[1]][k]] for k, x in enumerate(entered)]
    return {"pre": carried[:-1], "post": carried[1:], "resnet": branch}


def test_features_equal_those_of_a_plain_full_forward(folder: Path) -> None:
    crops = some_crops(2)
    noise = torch.randn((4, 16, 16), generator=torch.Generator().manual_seed(7))
    plain = plain_forward(folder, crops, timestep=50, noise=noise)
    for hook in HOOKS:
        spec = extractor(folder, hook=hook, seed=7)
        maps = spec.load(CPU)(crops, LAYERS)
        for k in LAYERS:
            assert tuple(maps[k].shape) == (2, *spec.feature_shape(k))
            assert maps[k].dtype == torch.float32
            # a difference of two sums loses digits that the branch itself has
            assert_close(maps[k], plain[hook][k], 1e-4 if hook == "resnet" else 1e-5)


def test_batch_of_one_equals_batch_of_four(sd1: Path) -> None:
    for noise in ("shared", "independent"):
        backbone = extractor(sd1, noise=noise).load(CPU)
        crops = some_crops(4)
        together = backbone(crops, PAPER_LAYERS)
        for i in range(4):
            alone = backbone(crops[[i]], PAPER_LAYERS)
            for k in PAPER_LAYERS:
                assert_close(alone[k][0], together[k][i])


def test_same_batch_gives_the_same_bytes(sd1: Path) -> None:
    crops, spec = some_crops(3), extractor(sd1, noise="independent")
    first, second = (spec.load(CPU)(crops, PAPER_LAYERS) for _ in range(2))
    for k in PAPER_LAYERS:
        assert first[k].numpy().tobytes() == second[k].numpy().tobytes()


def test_the_order_of_layers_and_their_number_do_not_matter(sd1: Path) -> None:
    backbone, crops = extractor(sd1).load(CPU), some_crops(2)
    asked = backbone(crops, [11, 2, 2])
    assert list(asked) == [11, 2]
    assert torch.equal(asked[2], backbone(crops, [2])[2])
    assert backbone(crops, []) == {}


def test_features_are_ordinary_tensors_that_may_be_changed(sd1: Path) -> None:
    maps = extractor(sd1).load(CPU)(some_crops(1), [2])[2]
    maps.div_(2)
    assert not maps.is_inference()
    assert not maps.requires_grad


def test_nothing_is_computed_past_the_deepest_block(sd1: Path) -> None:
    backbone = extractor(sd1).load(CPU)
    unet = backbone.model.unet
    calls: list[str] = []
    for name, module in unet.named_modules():
        module.register_forward_pre_hook(lambda _m, _i, name=name: calls.append(name))
    backbone(some_crops(1), [5, 2])
    assert calls.count("up_blocks.1.attentions.1") == 1
    later = (
        "up_blocks.1.resnets.2",
        "up_blocks.1.attentions.2",
        "up_blocks.1.upsamplers",
        "up_blocks.2",
        "conv_norm_out",
    )
    assert not [name for name in calls if name.startswith(later)]
    assert backbone.model.vae.decoder is None


def test_hooks_are_removed_from_the_model(sd1: Path) -> None:
    backbone = extractor(sd1).load(CPU)
    backbone(some_crops(1), PAPER_LAYERS)
    assert not any(module._forward_hooks for module in backbone.model.unet.modules())


def test_shared_noise_is_one_tensor_and_independent_noise_depends_on_content(sd1: Path) -> None:
    crops = some_crops(3)
    twice = crops[[0, 1, 0]]
    shared = features(sd1, twice, [11])[11]
    independent = features(sd1, twice, [11], noise="independent")[11]
    assert_close(independent[0], independent[2])
    assert_close(shared[0], shared[2])
    other_mask = Crops(crops.rgb, ~crops.mask, crops.A_crop_img)
    moved = features(sd1, other_mask, [11], noise="independent")[11]
    assert (moved[0] - independent[0]).abs().max() > 0.1
    assert_close(features(sd1, other_mask, [11])[11][:2], shared[:2])


def test_without_noise_the_latent_is_clean_and_the_timestep_still_matters(sd1: Path) -> None:
    crops, layers = some_crops(1), [8]
    spec = extractor(sd1, noise="none", timestep=261)
    backbone = spec.load(CPU)
    with torch.no_grad():
        latent = backbone._encode(crops.rgb)
        expected = read_decoder_maps(backbone.model.unet, latent, 261, backbone.model.prompt, layers=layers, hook="pre")
    assert_close(backbone(crops, layers)[8], expected[8])
    at_zero = features(sd1, crops, layers, noise="none", timestep=0)[8]
    assert (at_zero - expected[8]).abs().max() > 1e-3


def test_seed_and_ensemble_do_not_change_a_recipe_without_noise(sd1: Path) -> None:
    assert extractor(sd1, noise="none", seed=3, ensemble=4).recipe() == extractor(sd1, noise="none").recipe()
    assert extractor(sd1, seed=3).recipe() != extractor(sd1).recipe()


def test_ensemble_is_the_mean_over_its_seeds(sd1: Path) -> None:
    crops = some_crops(2)
    for noise in ("shared", "independent"):
        singles = [features(sd1, crops, PAPER_LAYERS, noise=noise, seed=s) for s in (5, 6, 7)]
        mean = features(sd1, crops, PAPER_LAYERS, noise=noise, seed=5, ensemble=3)
        for k in PAPER_LAYERS:
            assert_close(mean[k], sum(maps[k] for maps in singles) / 3)


def test_timestep_zero_and_the_last_one_work(sd1: Path) -> None:
    for timestep in (0, 999):
        maps = features(sd1, some_crops(1), [2], timestep=timestep)
        assert torch.isfinite(maps[2]).all()


@pytest.mark.parametrize("dtype", ["float16", "bfloat16"])
def test_half_precision_is_close_to_full(sd1: Path, dtype: str) -> None:
    crops = some_crops(2)
    full = features(sd1, crops, PAPER_LAYERS)
    half = features(sd1, crops, PAPER_LAYERS, dtype=dtype)
    epsilon = torch.finfo(getattr(torch, dtype)).eps
    for k in PAPER_LAYERS:
        assert half[k].dtype == getattr(torch, dtype)
        cosine = torch.nn.functional.cosine_similarity(half[k].float(), full[k], dim=1).mean()
        # some hundred roundings of random sign between the image and the map
        assert 1 - cosine < 100 * epsilon


def test_a_prompt_changes_the_features(sd1: Path) -> None:
    crops = some_crops(1)
    plain, prompted = (features(sd1, crops, [5], prompt=p)[5] for p in ("", "a b c"))
    assert (plain - prompted).abs().max() > 1e-3


def test_batch_size_follows_memory_unless_it_is_given(sd1: Path) -> None:
    small, large = (extractor(sd1, input_size=s).load(Runtime(device="cpu")).passes for s in (128, 1024))
    assert small.size == 16  # more gain nothing on a CPU
    assert 1 <= large.size < small.size
    for passes in (small, large):
        assert passes.batch in {n * passes.size for n in range(1, worker_count() + 1)}


def test_sizes_and_channels_on_the_configuration_of_sd15(tmp_path: Path) -> None:
    config = unet_config(small=False, version=1)
    at_512 = {k: map_shape(config, layer=k, hook="pre", latent_size=64) for k in PAPER_LAYERS}
    assert at_512 == {2: (1280, 8, 8), 5: (1280, 16, 16), 8: (640, 32, 32), 11: (320, 64, 64)}
    with torch.device("meta"):
        unet = UNet2DConditionModel.from_config(config)
    for size in (32, 64):
        latent, prompt = torch.empty((1, 4, size, size), device="meta"), torch.empty((1, 77, 768), device="meta")
        for hook in HOOKS:
            maps = read_decoder_maps(unet, latent, 50, prompt, layers=LAYERS, hook=hook)
            for k in LAYERS:
                assert tuple(maps[k].shape[1:]) == map_shape(config, layer=k, hook=hook, latent_size=size)


def test_a_layer_timestep_or_size_the_model_does_not_have_is_named(sd1: Path) -> None:
    with pytest.raises(BadInput, match=r"layer: found 12, needs 0\.\.11"):
        extractor(sd1).feature_shape(12)
    with pytest.raises(BadInput, match=r"layer: found -1, needs 0\.\.11"):
        extractor(sd1).load(CPU)(some_crops(1), [2, -1])
    with pytest.raises(BadInput, match=r"extract\.timestep: found 1000, needs 0\.\.999"):
        extractor(sd1, timestep=1000).load(CPU)
    with pytest.raises(BadInput, match=r"extract\.input_size: found 500, needs a multiple of 64"):
        extractor(sd1, input_size=500).feature_shape(2)
    with pytest.raises(BadInput, match=r"extract\.hook"):
        extractor(sd1, hook="middle")
    with pytest.raises(BadInput, match=r"extract\.ensemble"):
        extractor(sd1, ensemble=0)


_SUBPROCESS = """
import sys
import numpy as np
from benchmarks.measure import peak_bytes
from pipeline.items.features import FeatureMaps
from pipeline.items.views import Crops
from pipeline.parallel import use_threads
from pipeline.spec import Runtime
from pipeline.stages.extract.stable_diffusion import StableDiffusion
use_threads(1)  # each further thread takes the memory of one more pass; runtime.max_memory bounds them
rng = np.random.default_rng(0)
n = 3  # a full pass has more: what the others would take is added below
rgb = rng.integers(0, 256, (n, 128, 128, 3), dtype=np.uint8)
crops = Crops(rgb, np.ones((n, 128, 128), bool), np.tile(np.eye(3), (n, 1, 1)))
spec = StableDiffusion(weights=sys.argv[1], input_size=256)
backbone = spec.load(Runtime(device="cpu"))
maps = backbone(crops, [2, 5, 8, 11])
assert all(tuple(v.shape) == (n, *spec.feature_shape(k)) for k, v in maps.items())
assert [spec.feature_shape(k) for k in maps] == [(1280, 4, 4), (1280, 8, 8), (640, 16, 16), (320, 32, 32)]
assert all(bool(np.isfinite(v.numpy()).all()) for v in maps.values())
others = backbone.passes.batch - n
assert others >= 0
print(peak_bytes() + others * spec.footprint([2, 5, 8, 11], 128).bytes_per_crop)
"""


@pytest.mark.slow
def test_full_size_sd15_in_float32_stays_under_6_gigabytes(tmp_path: Path) -> None:
    root = write_folder(tmp_path / "sd15", small=False, dtype="float16", blank=True)
    try:
        done = subprocess.run(
            [sys.executable, "-c", _SUBPROCESS, str(root)], capture_output=True, text=True, check=False
        )
    finally:
        for path in root.rglob("*.safetensors"):
            path.unlink()  # 2 GB that pytest would keep for three runs
    assert done.returncode == 0, done.stderr
    peak_bytes = int(done.stdout.split()[-1])
    assert peak_bytes < 6e9
