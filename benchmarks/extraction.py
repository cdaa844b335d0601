"""Images per second of the diffusion extractor compared with bare calls of its U-Net and VAE."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
import torch

from benchmarks.measure import Measurement, time_interleaved
from pipeline.backbones.determinism import use_deterministic_convolutions
from pipeline.backbones.stable_diffusion.features import DiffusionBackbone, DiffusionFeatures
from pipeline.items.views import Crops
from pipeline.spec import Runtime
from pipeline.stages.extract.embedded import Embedded
from pipeline.stages.extract.random_sd import RandomSD

LAYERS = (2, 5, 8, 11)
SD_SIZE: dict[str, Any] = {
    "channels": (320, 640, 1280, 1280),
    "vae_channels": (128, 256, 512, 512),
    "cross_attention_dim": 768,
    "input_size": 512,
}
"""SD 1.5's widths, with random weights: 3.4 GB in float32."""


class _Reached(Exception):
    """Stops the U-Net's forward pass."""


def extraction(*, device: str, repeats: int) -> list[Measurement]:
    """The embedded model: speed relative to bare forward passes."""
    return _extraction("the embedded model", Embedded(), device=device, repeats=repeats, images=8)


def extraction_sd(*, device: str, repeats: int) -> list[Measurement]:
    """A model of SD 1.5's size with random weights; takes minutes on a CPU."""
    images, repeats = (16, repeats) if device.startswith("cuda") else (1, min(repeats, 3))
    return _extraction("SD 1.5's size", RandomSD(**SD_SIZE), device=device, repeats=repeats, images=images)


def _extraction(name: str, spec: DiffusionFeatures, *, device: str, repeats: int, images: int) -> list[Measurement]:
    backbone = spec.load(Runtime(device=device))
    rgb = np.random.default_rng(0).integers(0, 256, (images, 128, 128, 3), dtype=np.uint8)
    crops = Crops(rgb, np.ones((images, 128, 128), bool), np.repeat(np.eye(3)[None], images, 0))
    times = time_interleaved(
        {"ours": lambda: backbone(crops, LAYERS), "bare": lambda: _bare(backbone, images)}, repeats=repeats
    )
    seconds = {key: t.wall_s if device.startswith("cuda") else t.cpu_s for key, t in times.items()}
    unit = "images/s" if device.startswith("cuda") else "images/s of one core"
    return [
        Measurement(f"images of {name}", images / seconds["ours"], unit),
        Measurement(
            f"images of {name}", 100 * seconds["bare"] / seconds["ours"], "%", "bare VAE and U-Net", 95.0, "more"
        ),
    ]  # fmt: skip


@torch.inference_mode()
def _bare(backbone: DiffusionBackbone, images: int) -> None:
    """VAE encoder and U-Net up to the block before which the deepest layer is read, at the same precision."""
    model, spec = backbone.model, backbone.spec
    like: dict[str, Any] = {"device": model.prompt.device, "dtype": model.prompt.dtype}
    vae: Any = model.vae
    unet: Any = model.unet
    step = min(images, backbone.passes.size)
    deepest = unet.up_blocks[3].resnets[2]
    stop = deepest.register_forward_pre_hook(_stop_pass)
    try:
        for _ in range(0, images, step):
            with use_deterministic_convolutions():
                latent = vae.encode(torch.zeros(step, 3, spec.input_size, spec.input_size, **like)).latent_dist.mean
            with use_deterministic_convolutions(), contextlib.suppress(_Reached):
                unet(latent, torch.tensor(spec.timestep), model.prompt.expand(step, -1, -1))
    finally:
        stop.remove()


def _stop_pass(*_: object) -> None:
    raise _Reached
