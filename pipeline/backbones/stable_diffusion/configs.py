"""Checks of Stable Diffusion's configs: which models are supported; and the noise schedule."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.errors import BadInput
from pipeline.io.checkpoints import first_line

MAX_LAYERS, MAX_LEVELS = 16, 8  # of a U-Net; Stable Diffusion has 2 and 4
_SCHEDULE = {"num_train_timesteps": 1000, "beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear"}
_SCHEDULE_FIELDS = (*_SCHEDULE, "trained_betas", "rescale_betas_zero_snr")


def check_unet(config: Mapping[str, Any], where: Path) -> None:
    """Raise BadInput, naming the field, for a U-Net other than Stable Diffusion 1.x's or 2.x's."""
    check_class(config, "UNet2DConditionModel", where)
    for name in ("addition_embed_type", "class_embed_type", "encoder_hid_dim_type"):
        if config.get(name) is not None:
            raise BadInput(
                where, found=f"{name} {config[name]!r}", needed="none, as Stable Diffusion 1.x and 2.x have it"
            )
    check_fields(config, ("block_out_channels", "layers_per_block", "cross_attention_dim"), where)
    for name in ("layers_per_block", "cross_attention_dim"):
        if not isinstance(config[name], int):
            raise BadInput(where, found=f"{name} {config[name]!r}", needed="one whole number")
    blocks, levels = config["layers_per_block"], config["block_out_channels"]
    if not (1 <= blocks <= MAX_LAYERS and isinstance(levels, list) and len(levels) <= MAX_LEVELS):
        found = f"layers_per_block {blocks}, {len(levels) if isinstance(levels, list) else levels} levels"
        raise BadInput(where, found=found, needed=f"at most {MAX_LAYERS} layers a block and {MAX_LEVELS} levels")
    if unknown := sorted(set(config.get("up_block_types", ())) - {"UpBlock2D", "CrossAttnUpBlock2D"}):
        raise BadInput(where, found=f"up_block_types {unknown[0]!r}", needed="UpBlock2D or CrossAttnUpBlock2D")


def check_class(config: Mapping[str, Any], name: str, where: Path) -> None:
    """Raise BadInput for the config of another class."""
    if config.get("_class_name") != name:
        raise BadInput(where, found=f"_class_name {config.get('_class_name')!r}", needed=name)


def check_fields(config: Mapping[str, Any], names: Sequence[str], where: Path) -> None:
    """Raise BadInput for a config that lacks one of the fields."""
    for name in names:
        if not config.get(name):
            raise BadInput(where, found=f"no {name}", needed=f"the config of a {config['_class_name']}")


def check_latents(unet: Mapping[str, Any], vae: Mapping[str, Any], where: Path) -> None:
    """Raise BadInput for a U-Net with further inputs than the latent: inpainting, depth, editing, upscaling."""
    needed = int(vae.get("latent_channels", 4))
    if unet.get("in_channels", 4) != needed:
        found = f"in_channels {unet['in_channels']}"
        raise BadInput(where, found=found, needed=f"{needed}, the latent alone (no inpainting or depth model)")


def alphas_cumprod(scheduler: Mapping[str, Any], where: Path | None = None) -> Float[np.ndarray, " timesteps"]:
    """abar_t of a scheduler's config; missing fields are those of Stable Diffusion's scaled-linear schedule."""
    from diffusers import DDPMScheduler

    if "Flow" in str(scheduler.get("_class_name", "")):
        raise BadInput(where, found=f"_class_name {scheduler['_class_name']!r}", needed="a scheduler with betas")
    try:
        ddpm: Any = DDPMScheduler(**schedule_fields(scheduler))
        return ddpm.alphas_cumprod.double().numpy()
    except (NotImplementedError, TypeError, ValueError, RuntimeError) as error:
        raise BadInput(where, found=first_line(error), needed="a schedule of betas that diffusers knows") from None


def schedule_fields(scheduler: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a scheduler's config that the noise depends on; missing ones are Stable Diffusion's."""
    given = {name: scheduler.get(name) for name in _SCHEDULE_FIELDS}
    return _SCHEDULE | {name: value for name, value in given.items() if value is not None and value is not False}
