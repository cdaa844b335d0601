"""Weights of Stable Diffusion on disk, in any format: their configs, their tensors and the models made of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from pipeline.backbones.stable_diffusion.features import DiffusionConfigs
from pipeline.backbones.stable_diffusion.identity import VERSION, Part, digest_content
from pipeline.backbones.stable_diffusion.loading import (
    Stored,
    allocate_encoder,
    allocate_unet,
    build_text_encoder,
    copy_weight,
    encode_text,
    lay_out,
)
from pipeline.io.digests import derived_digest


class Weights(ABC):
    """A Stable Diffusion model on disk. The models that it loads are on the CPU."""

    @property
    @abstractmethod
    def files(self) -> dict[str, Path]:
        """The files that are read, by name."""

    @abstractmethod
    def read_configs(self) -> DiffusionConfigs:
        """Configs, checked to be Stable Diffusion 1.x or 2.x. Raises BadInput."""

    @abstractmethod
    def read_config(self, part: Part | str) -> Mapping[str, Any]:
        """The config of a part or of the "scheduler", under the names of diffusers and transformers."""

    @abstractmethod
    def config_place(self, part: Part) -> Path:
        """The file that a part's config is read from, for messages."""

    @abstractmethod
    def read_tensors(self, part: Part, wanted: Mapping[str, Tensor]) -> Iterator[Stored]:
        """The stored tensors of a part, by the names in ``wanted``. Raises BadInput for missing ones."""

    @abstractmethod
    def tokenize(self, text: str) -> Int[Tensor, "1 l"]:
        """Token ids of a prompt. Raises BadInput for a text that needs a tokenizer, or is too long."""

    def digest(self) -> str:
        """sha256 (hex) of everything that features are computed from but the prompt; see identity.py."""
        self.read_configs()  # checked first, so that weights of another class are refused by their class
        return derived_digest(VERSION, self.files, lambda: digest_content(self))

    def tensors(self, part: Part) -> Iterator[Stored]:
        """The tensors of a part that are used, by their names in diffusers and transformers. Raises BadInput."""
        return self.read_tensors(part, lay_out(part, self.read_config(part), self.config_place(part)))

    def load_unet(self, dtype: torch.dtype) -> nn.Module:
        """The U-Net. Raises BadInput for weights that do not fit the config."""
        return self._fill(allocate_unet(self.read_config("unet"), dtype, self.config_place("unet")), "unet")

    def load_vae(self, dtype: torch.dtype) -> nn.Module:
        """The VAE without its decoder. Raises BadInput as ``load_unet``."""
        return self._fill(allocate_encoder(self.read_config("vae"), dtype, self.config_place("vae")), "vae")

    def encode_prompt(self, text: str) -> Float[Tensor, "1 l d"]:
        """The text encoder's last hidden state, float32; frees the encoder. Raises BadInput as ``load_unet``."""
        ids = self.tokenize(text)
        outer, inner = build_text_encoder(self.read_config("text_encoder"), self.config_place("text_encoder"))
        self._fill(inner, "text_encoder")
        return encode_text(outer, ids)

    def _fill(self, model: nn.Module, part: Part) -> nn.Module:
        parameters = dict(model.named_parameters())
        with torch.no_grad():
            for name, value, where in self.read_tensors(part, parameters):
                copy_weight(value, parameters[name], where)
        return model
