"""Weights of Stable Diffusion at a hub id, in a diffusers folder or in one .safetensors file; never pickled."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor, nn

from pipeline.backbones.stable_diffusion.diffusers_folder import FIELD, NAME, DiffusersFolder, download
from pipeline.backbones.stable_diffusion.features import DiffusionConfigs
from pipeline.backbones.stable_diffusion.single_file import SingleFile
from pipeline.errors import BadInput
from pipeline.io.checkpoints import is_local, resolve_hub_cache, sweep_hint


class Weights(Protocol):
    """A Stable Diffusion model on disk. The models that it loads are on the CPU."""

    @property
    def files(self) -> dict[str, Path]:
        """The files whose bytes determine the features, by name."""
        ...

    def read_configs(self) -> DiffusionConfigs:
        """Configs, checked to be Stable Diffusion 1.x or 2.x. Raises BadInput."""
        ...

    def load_unet(self, dtype: torch.dtype) -> nn.Module:
        """The U-Net. Raises BadInput for weights that do not fit the config."""
        ...

    def load_vae(self, dtype: torch.dtype) -> nn.Module:
        """The VAE without its decoder. Raises BadInput as ``load_unet``."""
        ...

    def encode_prompt(self, text: str) -> Float[Tensor, "1 l d"]:
        """The text encoder's last hidden state, float32; frees the encoder. Raises BadInput as ``load_unet``."""
        ...


def open_weights(weights: str, revision: str | None) -> Weights:
    """Locate weights at a hub id, in a diffusers folder, or in one .safetensors file in the original layout."""
    if not is_local(weights):
        return DiffusersFolder(download(weights, revision))
    path = Path(weights).expanduser()
    if not path.exists():
        needed = "a diffusers folder or a .safetensors file" + sweep_hint(NAME)
        raise BadInput(FIELD, found=f"{weights!r}, which does not exist", needed=needed)
    if path.is_dir():
        return DiffusersFolder(resolve_hub_cache(path, FIELD))
    if path.suffix != ".safetensors":
        raise BadInput(FIELD, found=f"{weights!r}", needed="safetensors: convert it, pickled weights are never opened")
    return SingleFile(path)
