"""The noise of diffusion features: how it is drawn, and how it is added to the latent."""

from __future__ import annotations

from hashlib import sha256
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

NoiseMode = Literal["shared", "independent", "none"]


def draw_noise(
    mode: Literal["shared", "independent"],
    rgb: UInt8[np.ndarray, "n S S 3"],
    mask: Bool[np.ndarray, "n S S"],
    *,
    seed: int,
    shape: tuple[int, int, int],
) -> Float[Tensor, "n c h w"]:
    """Unit Gaussian noise for n crops, drawn on the CPU so that every device gets the same values.

    ``shared``: one tensor for all crops. ``independent``: each crop's content seeds its noise, which is therefore
    independent of batch and order.
    """
    if mode == "shared":
        return _draw_gaussian(seed, shape).expand(len(rgb), *shape)
    return torch.stack([_draw_gaussian(_content_seed(seed, rgb[i], mask[i]), shape) for i in range(len(rgb))])


def add_noise(
    latent: Float[Tensor, "n c h w"], noise: Float[Tensor, "n c h w"], *, alpha_cumprod: float
) -> Float[Tensor, "n c h w"]:
    """sqrt(abar_t) z + sqrt(1 - abar_t) eps (Ho et al., NeurIPS 2020, Eq. 4)."""
    return alpha_cumprod**0.5 * latent + (1 - alpha_cumprod) ** 0.5 * noise


def _draw_gaussian(seed: int, shape: tuple[int, int, int]) -> Float[Tensor, "c h w"]:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def _content_seed(seed: int, rgb: UInt8[np.ndarray, "S S 3"], mask: Bool[np.ndarray, "S S"]) -> int:
    content = sha256(f"{seed}\0".encode() + rgb.tobytes() + mask.tobytes()).digest()
    return int.from_bytes(content[:8], "little") >> 1  # torch takes 63 bits
