"""Masks of crops at the resolution of feature maps."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

_ROUNDING = 1e-5  # half covered in float32 still counts as half


def cell_coverage(mask: Bool[Tensor, "*n S S"], *, cells: int) -> Float[Tensor, "*n cells_y cells_x"]:
    """Part of each cell's area that the mask covers, 0..1; exact for any ratio of pixels to cells."""
    size = mask.shape[-1]
    stride = size / cells
    pixel = torch.arange(size, dtype=torch.float64)
    cell = torch.arange(cells, dtype=torch.float64)[:, None] * stride
    overlap = torch.minimum(cell + stride, pixel + 1) - torch.maximum(cell, pixel)
    weights = (overlap.clamp(min=0) / stride).to(mask.device, torch.float32)
    return weights @ mask.float() @ weights.T


def cell_mask(mask: Bool[Tensor, "*n S S"], *, cells: int) -> Bool[Tensor, "*n cells_y cells_x"]:
    """Foreground cells: those at least half covered.

    Where no cell is, the best covered one stands in, so that a mask with a pixel never has no cell.
    """
    cover = cell_coverage(mask, cells=cells).flatten(-2)
    half = cover >= 0.5 - _ROUNDING
    best, index = cover.max(-1, keepdim=True)
    stand_in = torch.zeros_like(half).scatter_(-1, index, best > 0)
    return torch.where(half.any(-1, keepdim=True), half, stand_in).unflatten(-1, (cells, cells))


def foreground(mask: Bool[Tensor, "*cells"]) -> Int[Tensor, " m"]:
    """Flat indices of a cell mask's foreground, in reading order."""
    return mask.flatten().nonzero()[:, 0]
