"""The baseline with random weights: equal on every machine; Stable Diffusion's architecture with other widths."""

import hashlib

import numpy as np
import pytest
import torch

from pipeline.backbones.stable_diffusion.features import to_network_image
from pipeline.backbones.stable_diffusion.noise import add_noise, draw_noise
from pipeline.errors import BadInput
from pipeline.items.views import Crops
from pipeline.spec import Runtime, build
from pipeline.stages.extract.random_sd import RandomSD

CPU = Runtime(device="cpu", batch=8)
LAYERS = (2, 5, 8, 11)


def some_crops(n: int = 2) -> Crops:
    rgb = np.random.default_rng(0).integers(0, 256, (n, 128, 128, 3), dtype=np.uint8)
    return Crops(rgb, np.ones((n, 128, 128), bool), np.tile(np.eye(3), (n, 1, 1)))


def test_weights_depend_on_names_and_seed_alone() -> None:
    torch.manual_seed(1)
    first = RandomSD().load_model()
    torch.manual_seed(2)
    second = RandomSD().load_model()
    for name, value in first.unet.state_dict().items():
        assert torch.equal(second.unet.state_dict()[name], value)
    assert torch.equal(first.prompt, second.prompt)
    key = int.from_bytes(hashlib.sha256(b"0\0conv_in.weight").digest()[:8], "little") >> 1
    expected = torch.randn((32, 4, 3, 3), generator=torch.Generator().manual_seed(key)) / 36**0.5
    torch.testing.assert_close(first.unet.state_dict()["conv_in.weight"], expected)


def test_loading_does_not_change_the_global_random_state() -> None:
    torch.manual_seed(0)
    before = torch.get_rng_state()
    RandomSD().load(CPU)(some_crops(1), [2])
    assert torch.equal(torch.get_rng_state(), before)


def test_model_names_widths_and_weights_seed_and_nothing_else() -> None:
    names = {RandomSD(**kw).model for kw in ({}, {"weights_seed": 1}, {"channels": (32, 32, 64, 64)})}
    assert len(names) == 3
    assert RandomSD(timestep=3, noise="none", hook="post").model == RandomSD().model
    assert all(name.startswith("random_sd-") for name in names)


def test_its_decoder_has_twelve_blocks_of_the_sizes_of_feature_shape() -> None:
    crops = some_crops(1)
    for hook in ("pre", "post", "resnet"):
        spec = RandomSD(hook=hook)
        maps = spec.load(CPU)(crops, range(12))
        assert {k: tuple(v.shape[1:]) for k, v in maps.items()} == {k: spec.feature_shape(k) for k in range(12)}
        assert all(torch.isfinite(v).all() for v in maps.values())
    with pytest.raises(BadInput, match=r"needs 0\.\.11"):
        RandomSD().feature_shape(12)


def test_features_of_different_images_differ() -> None:
    maps = RandomSD(noise="none").load(CPU)(some_crops(2), LAYERS)
    for k in LAYERS:
        cosine = torch.nn.functional.cosine_similarity(maps[k][0].flatten(), maps[k][1].flatten(), dim=0)
        assert cosine < 0.99


def test_widths_that_cannot_be_built_are_refused() -> None:
    for field, value in (("channels", (30, 64, 64, 64)), ("vae_channels", ()), ("channels", (32, 64, 64))):
        with pytest.raises(BadInput, match=rf"extract\.{field}"):
            build(RandomSD, {field: value}, where="extract")


def test_noising_keeps_unit_variance_and_ends_are_exact() -> None:
    latent, noise = torch.randn(2, 4, 64, 64), torch.randn(2, 4, 64, 64)
    assert torch.equal(add_noise(latent, noise, alpha_cumprod=1.0), latent)
    assert torch.equal(add_noise(latent, noise, alpha_cumprod=0.0), noise)
    # 32768 draws: the variance is known to 1/sqrt(16384) = 0.8 %
    assert abs(float(add_noise(latent, noise, alpha_cumprod=0.3).var()) - 1) < 0.04


def test_noise_follows_seed_and_content() -> None:
    crops = some_crops(3)
    rgb, mask = crops.rgb, crops.mask

    def noise(mode: str, seed: int = 0, rows: list[int] | None = None) -> torch.Tensor:
        rows = rows or [0, 1, 2]
        return draw_noise(mode, rgb[rows], mask[rows], seed=seed, shape=(4, 8, 8))

    assert torch.equal(noise("shared")[0], noise("shared")[2])
    assert torch.equal(noise("independent", rows=[2])[0], noise("independent")[2])
    assert not torch.equal(noise("independent")[0], noise("independent")[1])
    for mode in ("shared", "independent"):
        assert not torch.equal(noise(mode, seed=1), noise(mode))


def test_resizing_aligns_image_edges() -> None:
    ramp = torch.arange(0, 128, 2, dtype=torch.uint8).view(1, 1, 64, 1).expand(1, 64, 64, 3)
    image = to_network_image(ramp, size=256)
    # pixel x of 256 lies at (x + .5) / 4 - .5 of 64; value 2 x there, away from the border
    expected = 2 * ((torch.arange(256) + 0.5) / 4 - 0.5) / 127.5 - 1
    torch.testing.assert_close(image[0, 0, 0, 4:-4], expected[4:-4], rtol=0, atol=1e-6)
    assert to_network_image(ramp, size=64).max() < 0
    assert tuple(to_network_image(ramp, size=32).shape) == (1, 3, 32, 32)
