"""checkpoints -> the weights that ship: float16 safetensors, with the configs they belong to."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save
from torch import Tensor

from pipeline.embedded.training import UNET, VAE, Place
from pipeline.whole import write_whole

MOST_BYTES = 25_000_000
SCHEDULER = {"num_train_timesteps": 1000, "beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear"}


def export(place: Place, folder: Path) -> int:
    """Write the averages of all stages that have a checkpoint; returns the bytes written."""
    made: dict[str, bytes] = {}
    autoencoder = _saved(place, "autoencoder")
    if autoencoder is not None:
        made["vae.safetensors"] = _half(autoencoder["average"])
        config = {"unet": UNET, "vae": VAE | {"scaling_factor": autoencoder["scaling_factor"]}, "scheduler": SCHEDULER}
        made["config.json"] = (json.dumps(config, indent=1) + "\n").encode()
    denoiser = _saved(place, "denoiser")
    if denoiser is not None:
        made["unet_pure.safetensors"] = _half(denoiser["average"])
    described = _saved(place, "descriptors")
    if described is not None:
        made["unet_learned.safetensors"] = _half(_below("unet.", described["average"]))
        made["head.safetensors"] = _half(_below("head.", described["average"]))
    saved = {"autoencoder": autoencoder, "denoiser": denoiser, "descriptors": described}
    steps = {stage: state["step"] for stage, state in saved.items() if state is not None}
    made["steps.json"] = (json.dumps(steps, indent=1) + "\n").encode()
    size = sum(map(len, made.values()))
    if size > MOST_BYTES:
        raise ValueError(f"{size} bytes of weights, at most {MOST_BYTES} may ship")
    for name, content in made.items():
        write_whole(folder / name, content)
    return size


def _saved(place: Place, stage: str) -> dict[str, Any] | None:
    path = place.checkpoint(stage)
    return torch.load(path, weights_only=True) if path.exists() else None


def _below(prefix: str, state: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in state.items() if name.startswith(prefix)}


def _half(state: dict[str, Tensor]) -> bytes:
    return save({name: tensor.half().contiguous() for name, tensor in state.items()})
