"""Feature maps: one resolution for all layers, one scale."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate


def upsample(features: Float[Tensor, "c h w"], *, cells: int) -> Float[Tensor, "c cells_y cells_x"]:
    """Bilinear in between cell centres; cell edges stay on cell edges (align_corners=False)."""
    if features.shape[-1] == cells:
        return features
    return interpolate(features[None], size=(cells, cells), mode="bilinear", align_corners=False)[0]


def root_mean_square_norm(samples: Float[Tensor, "m c"]) -> Float[Tensor, ""]:
    """Root of the mean squared length of the rows; 1 where that is 0, so that it can divide."""
    norm = (samples * samples).sum(1).mean().sqrt()
    return torch.where(norm > 0, norm, torch.ones_like(norm))
