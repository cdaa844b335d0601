"""crops -> feature maps of published weights of Stable Diffusion's family: the base of such extractors."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import torch

from pipeline.backbones.stable_diffusion.features import DiffusionConfigs, DiffusionFeatures, LoadedModel
from pipeline.backbones.stable_diffusion.source import open_weights
from pipeline.backbones.stable_diffusion.weights import Weights
from pipeline.spec import digest, spec


@spec
class PretrainedDiffusion(DiffusionFeatures):
    """Base of extractors with U-Net, VAE and text encoder on disk.

    ``weights``: a hub id (with an optional ``revision``), a diffusers folder, or one .safetensors file in the original
    layout. The recipe holds the digest of the content instead of these two fields.
    """

    weights: str
    revision: str | None = None
    prompt: str = ""

    @property
    def name(self) -> str:
        """The variant's name, which is also that of its field in ``weights``."""
        return self.kind.partition(".")[2]

    @cached_property
    def source(self) -> Weights:
        """Where the weights are; a hub id is downloaded first. Raises BadInput."""
        return open_weights(self.weights, self.revision, self.name)

    @cached_property
    def weights_digest(self) -> str:
        """sha256 of what features are computed from; a folder and a single file of the same weights have the same."""
        return self.source.digest()

    @property
    def model(self) -> str:
        """The variant's name and the first 8 digits of the weights' digest."""
        return f"{self.name}-{self.weights_digest[:8]}"

    def recipe(self) -> dict[str, Any]:
        """As Spec.recipe, with the digest of the weights and the prompt's tokens instead of files."""
        recipe = super().recipe() | {"weights": self.weights_digest, "tokens": digest(self.tokens)}
        del recipe["revision"]
        return recipe

    @cached_property
    def tokens(self) -> list[int]:
        """Token ids of the prompt. Raises BadInput for a text that needs a tokenizer, or is too long."""
        ids: list[int] = self.source.tokenize(self.prompt)[0].tolist()
        return ids

    @cached_property
    def configs(self) -> DiffusionConfigs:
        """Configs of the weights' U-Net, VAE and scheduler. Raises BadInput."""
        return self.source.read_configs()

    def load_model(self) -> LoadedModel:
        """Weights on the CPU; the text encoder is freed before the U-Net is loaded, to keep peak memory low."""
        dtype = getattr(torch, self.dtype)
        prompt = self.source.encode_prompt(self.prompt).to(dtype)
        return LoadedModel(self.source.load_unet(dtype), self.source.load_vae(dtype), prompt)
