"""checkpoints -> the weights that ship: float16 safetensors, with the configs they belong to."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save
from torch import Tensor

from pipeline.embedded.training import UNET, VAE, Place
from pipeline.io.files import write_atomic

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
    curves = {stage: _curve(place, stage) for stage in ("autoencoder", "denoiser", "descriptors")}
    made["losses.json"] = (json.dumps(curves) + "\n").encode()
    size = sum(map(len, made.values()))
    if size > MOST_BYTES:
        raise ValueError(f"{size} bytes of weights, at most {MOST_BYTES} may ship")
    for name, content in made.items():
        write_atomic(folder / name, content)
    return size


def _curve(place: Place, stage: str) -> list[dict[str, float]]:
    """Losses of the first steps, of every 25th and of the last: a repeated training can be held against them."""
    path = place.curve(stage)
    records = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    kept = [record for record in records if record["step"] < 20 or record["step"] % 25 == 0] + records[-1:]
    by_step = {record["step"]: record for record in kept}  # steps after a checkpoint that was gone back to come twice
    return [{name: value for name, value in record.items() if name != "at"} for record in by_step.values()]


def _saved(place: Place, stage: str) -> dict[str, Any] | None:
    path = place.checkpoint(stage)
    return torch.load(path, map_location="cpu", weights_only=True) if path.exists() else None


def _below(prefix: str, state: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in state.items() if name.startswith(prefix)}


def _half(state: dict[str, Tensor]) -> bytes:
    return save({name: tensor.half().contiguous() for name, tensor in state.items()})
