"""Weights of Stable Diffusion at a hub id, in a diffusers folder or in one .safetensors file; never pickled."""

from __future__ import annotations

from pathlib import Path

from pipeline.backbones.stable_diffusion.diffusers_folder import FIELD, NAME, DiffusersFolder, download
from pipeline.backbones.stable_diffusion.single_file import SingleFile
from pipeline.backbones.stable_diffusion.weights import Weights
from pipeline.errors import BadInput
from pipeline.io.checkpoints import is_local, resolve_hub_cache, sweep_hint


def open_weights(weights: str, revision: str | None, name: str = NAME) -> Weights:
    """Locate weights at a hub id, in a diffusers folder, or in one .safetensors file in the original layout.

    ``name``: the model's field in ``weights``, for messages. Raises BadInput.
    """
    if not is_local(weights):
        return DiffusersFolder(download(weights, revision, name))
    path = Path(weights).expanduser()
    if not path.exists():
        needed = "a diffusers folder or a .safetensors file" + sweep_hint(name)
        raise BadInput(FIELD, found=f"{weights!r}, which does not exist", needed=needed)
    if path.is_dir():
        return DiffusersFolder(resolve_hub_cache(path, FIELD))
    if path.suffix != ".safetensors":
        raise BadInput(FIELD, found=f"{weights!r}", needed="safetensors: convert it, pickled weights are never opened")
    return SingleFile(path)
