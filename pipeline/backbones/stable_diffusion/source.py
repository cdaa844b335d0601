"""Where the weights of Stable Diffusion lie: a hub id, a diffusers folder or one .safetensors file, never pickled."""

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
from pipeline.io.checkpoints import is_local, sweep_hint


class Weights(Protocol):
    """A place that holds a Stable Diffusion model. ``files``: all that is read from it, by name."""

    @property
    def files(self) -> dict[str, Path]:
        """The files whose bytes decide the features."""
        ...

    def read_configs(self) -> DiffusionConfigs:
        """Configs, checked to be Stable Diffusion 1.x or 2.x. Raises BadInput."""
        ...

    def unet(self, dtype: torch.dtype) -> nn.Module:
        """The U-Net. Raises BadInput for weights that do not fit the config."""
        ...

    def vae(self, dtype: torch.dtype) -> nn.Module:
        """The VAE, its decoder dropped. Raises BadInput as ``unet`` does."""
        ...

    def prompt(self, text: str) -> Float[Tensor, "1 l d"]:
        """The text encoder's last hidden state, float32; the encoder is freed. Raises BadInput as ``unet`` does."""
        ...


def open_weights(weights: str, revision: str | None) -> Weights:
    """What lies at a hub id, in a diffusers folder, or in one .safetensors file of the original layout."""
    if not is_local(weights):
        return DiffusersFolder(download(weights, revision))
    path = Path(weights).expanduser()
    if not path.exists():
        needed = "a diffusers folder or a .safetensors file" + sweep_hint(NAME)
        raise BadInput(FIELD, found=f"{weights!r}, which does not exist", needed=needed)
    if path.is_dir():
        return DiffusersFolder(path)
    if path.suffix != ".safetensors":
        raise BadInput(FIELD, found=f"{weights!r}", needed="safetensors: convert it, pickled weights are never opened")
    return SingleFile(path)
