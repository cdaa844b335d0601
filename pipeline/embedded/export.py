"""Checkpoints -> the weights that ship: float16 safetensors, their configuration, samples of the loss curves."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save
from torch import Tensor

from pipeline.embedded.networks import HOOK, IMAGE_PX, TIMESTEP, UNET, VAE
from pipeline.embedded.plan import TrainingFolder
from pipeline.io.files import write_atomic, write_json
from pipeline.stages.extract.embedded import Embedded, digest_weights

MAX_BYTES = 25_000_000
SCHEDULER = {"num_train_timesteps": 1000, "beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear"}


def export(training: TrainingFolder, folder: Path) -> int:
    """Write the averaged weights of all stages that have a checkpoint; returns the number of bytes.

    Raises ValueError for more than MAX_BYTES.
    """
    files: dict[str, bytes] = {}
    autoencoder = _load_checkpoint(training, "autoencoder")
    if autoencoder is not None:
        files["vae.safetensors"] = _to_half_safetensors(autoencoder["average"])
        config = {"unet": UNET, "vae": VAE | {"scaling_factor": autoencoder["scaling_factor"]}, "scheduler": SCHEDULER}
        files["config.json"] = (json.dumps(config, indent=1) + "\n").encode()
    denoiser = _load_checkpoint(training, "denoiser")
    if denoiser is not None:
        files["unet_pure.safetensors"] = _to_half_safetensors(denoiser["average"])
    descriptors = _load_checkpoint(training, "descriptors")
    if descriptors is not None:
        files["unet_learned.safetensors"] = _to_half_safetensors(_select_prefix("unet.", descriptors["average"]))
        files["head.safetensors"] = _to_half_safetensors(_select_prefix("head.", descriptors["average"]))
    curves = {stage: _sample_curve(training, stage) for stage in ("autoencoder", "denoiser", "descriptors")}
    files["losses.json"] = (json.dumps(curves) + "\n").encode()
    size = sum(map(len, files.values()))
    if size > MAX_BYTES:
        raise ValueError(f"found {size} bytes of weights, needs at most {MAX_BYTES}")
    for name, content in files.items():
        write_atomic(folder / name, content)
    if descriptors is not None:
        write_json(folder / "head.json", describe_features(folder))
    return size


def describe_features(folder: Path) -> dict[str, Any]:
    """What the head was trained on: the recipe of an extractor of the exported weights, for fuse=learned to compare."""
    extract = Embedded(weights="learned", hook=HOOK, input_size=IMAGE_PX, timestep=TIMESTEP, noise="none")
    fields = {name: getattr(extract, name) for name in ("kind", "hook", "input_size", "timestep", "noise")}
    return fields | {"weights": f"learned {digest_weights(folder, 'learned')}"}


def _sample_curve(training: TrainingFolder, stage: str) -> list[dict[str, float]]:
    """Losses of the first 20 steps, every 25th and the last, to compare a repeated training with."""
    path = training.curve(stage)
    records = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    kept = [record for record in records if record["step"] < 20 or record["step"] % 25 == 0] + records[-1:]
    by_step = {record["step"]: record for record in kept}  # a resumed training logs some steps twice
    return [{name: value for name, value in record.items() if name != "at"} for record in by_step.values()]


def _load_checkpoint(training: TrainingFolder, stage: str) -> dict[str, Any] | None:
    exists = training.checkpoint(stage).exists()
    return training.load_checkpoint(stage, torch.device("cpu")) if exists else None


def _select_prefix(prefix: str, state: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in state.items() if name.startswith(prefix)}


def _to_half_safetensors(state: dict[str, Tensor]) -> bytes:
    return save({name: tensor.half().contiguous() for name, tensor in state.items()})
