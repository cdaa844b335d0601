"""crops -> feature maps of a small U-Net of Stable Diffusion's architecture with random weights: a baseline.

It is not Stable Diffusion and is untrained: its scores show how far random convolutions get.
"""

from __future__ import annotations

import math
from functools import cached_property
from hashlib import sha256
from typing import Annotated, Any, ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from pipeline.backbones.stable_diffusion.configs import alphas_cumprod
from pipeline.backbones.stable_diffusion.features import DiffusionConfigs, DiffusionFeatures, LoadedModel
from pipeline.backbones.stable_diffusion.loading import allocate_encoder, allocate_unet
from pipeline.spec import NonNegative, Positive, digest, spec

_PROMPT_TOKENS = 77
_GROUPS = 8  # of every group norm

Width = Annotated[int, Field(ge=_GROUPS, multiple_of=_GROUPS)]


@spec
class RandomSD(DiffusionFeatures):
    """Random weights, drawn in memory from ``weights_seed``: a baseline, not Stable Diffusion.

    Uses the same diffusers classes and 12 decoder blocks as SD, with other widths: ``channels`` of the U-Net's levels
    and ``vae_channels`` of the encoder's. The number of encoder levels sets the VAE's factor (3: 4 px per latent cell).
    """

    kind: ClassVar[str] = "extract.random_sd"
    version: ClassVar[int] = 1
    notice: ClassVar[str] = (
        "note: a small U-Net with random weights stands in for Stable Diffusion; its poses show that the route works, "
        "not what diffusion features can do"
    )

    input_size: Positive = 128
    channels: tuple[Width, Width, Width, Width] = (32, 64, 128, 128)
    vae_channels: Annotated[tuple[Width, ...], Field(min_length=1)] = (32, 32, 32)
    cross_attention_dim: Positive = 32
    weights_seed: NonNegative = 0

    @property
    def model(self) -> str:
        """``random_sd-`` and 8 digits of the digest of widths and seed."""
        identity = [self.version, self.configs.unet, self.configs.vae, self.weights_seed]
        return f"random_sd-{digest(identity)[:8]}"

    @cached_property
    def configs(self) -> DiffusionConfigs:
        """Configs with the spec's widths and Stable Diffusion's noise schedule."""
        return DiffusionConfigs(
            unet_config(self.channels, self.cross_attention_dim), vae_config(self.vae_channels), alphas_cumprod({})
        )

    def load_model(self) -> LoadedModel:
        """Weights drawn from ``weights_seed``, the same on every machine."""
        dtype = getattr(torch, self.dtype)
        unet = randomise_weights(allocate_unet(self.configs.unet, dtype), seed=self.weights_seed)
        vae = randomise_weights(allocate_encoder(self.configs.vae, dtype), seed=self.weights_seed)
        prompt = draw_gaussian("prompt", (1, _PROMPT_TOKENS, self.cross_attention_dim), seed=self.weights_seed)
        return LoadedModel(unet, vae, prompt.to(dtype))


def unet_config(channels: tuple[int, ...], cross_attention_dim: int) -> dict[str, Any]:
    """A UNet2DConditionModel like SD 1.x's: attention on all levels but the coarsest."""
    levels = len(channels)
    return {
        "block_out_channels": channels,
        "layers_per_block": 2,
        "cross_attention_dim": cross_attention_dim,
        "attention_head_dim": [max(1, c // 32) for c in channels],  # how diffusers spells the number of heads
        "norm_num_groups": _GROUPS,
        "down_block_types": ("CrossAttnDownBlock2D",) * (levels - 1) + ("DownBlock2D",),
        "up_block_types": ("UpBlock2D",) + ("CrossAttnUpBlock2D",) * (levels - 1),
    }


def vae_config(channels: tuple[int, ...]) -> dict[str, Any]:
    """An AutoencoderKL like SD's."""
    return {
        "block_out_channels": channels,
        "layers_per_block": 1,
        "norm_num_groups": _GROUPS,
        "latent_channels": 4,
        "scaling_factor": 1.0,
        "down_block_types": ("DownEncoderBlock2D",) * len(channels),
        "up_block_types": ("UpDecoderBlock2D",) * len(channels),
    }


def randomise_weights(model: nn.Module, *, seed: int) -> nn.Module:
    """Overwrite the model's weights; each is drawn from ``seed`` and its name, so their order does not matter.

    Matrices and kernels: Gaussian of variance 1 / fan-in, which preserves the scale of activations. Norms: identity.
    """
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            parameter.copy_(_draw_initial(name, tuple(parameter.shape), seed=seed))
    return model


def _draw_initial(name: str, shape: tuple[int, ...], *, seed: int) -> Tensor:
    if len(shape) > 1:
        return draw_gaussian(name, shape, seed=seed) / math.prod(shape[1:]) ** 0.5
    return torch.ones(shape) if name.endswith("weight") else torch.zeros(shape)


def draw_gaussian(name: str, shape: tuple[int, ...], *, seed: int) -> Float[Tensor, "*shape"]:
    """Unit Gaussian values that depend on ``seed`` and ``name`` alone."""
    key = int.from_bytes(sha256(f"{seed}\0{name}".encode()).digest()[:8], "little") >> 1
    return torch.randn(shape, generator=torch.Generator().manual_seed(key))
