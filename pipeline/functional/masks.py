"""Masks: morphology, and crop masks at the resolution of feature maps."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from torch import Tensor

_ROUNDING = 1e-5  # a cell covered by exactly half counts as half in float32 too


def cell_coverage(mask: Bool[Tensor, "*n S S"], *, cells: int) -> Float[Tensor, "*n cells_y cells_x"]:
    """Fraction of each cell's area covered by the mask, 0..1; exact for any ratio of pixels to cells."""
    size = mask.shape[-1]
    stride = size / cells
    pixel = torch.arange(size, dtype=torch.float64)
    cell = torch.arange(cells, dtype=torch.float64)[:, None] * stride
    overlap = torch.minimum(cell + stride, pixel + 1) - torch.maximum(cell, pixel)
    weights = (overlap.clamp(min=0) / stride).to(mask.device, torch.float32)
    return weights @ mask.float() @ weights.T


def cell_mask(mask: Bool[Tensor, "*n S S"], *, cells: int) -> Bool[Tensor, "*n cells_y cells_x"]:
    """Foreground cells: those that the mask covers by at least half.

    If there are none, the cell covered most, so that a mask with at least one pixel has at least one cell.
    """
    coverage = cell_coverage(mask, cells=cells).flatten(-2)
    half_covered = coverage >= 0.5 - _ROUNDING
    most, index = coverage.max(-1, keepdim=True)
    fallback = torch.zeros_like(half_covered).scatter_(-1, index, most > 0)
    return torch.where(half_covered.any(-1, keepdim=True), half_covered, fallback).unflatten(-1, (cells, cells))


def foreground(mask: Bool[Tensor, "*cells"]) -> Int[Tensor, " m"]:
    """Flat indices of the True cells of a mask, in row-major order."""
    return mask.flatten().nonzero()[:, 0]


def erode(mask: Bool[np.ndarray, "H W"], *, radius: int) -> Bool[np.ndarray, "H W"]:
    """Erosion by a square of 2 ``radius`` + 1 pixels a side; what lies outside the image erodes nothing."""
    return ndimage.binary_erosion(mask, _square(radius), border_value=1)


def open_mask(mask: Bool[np.ndarray, "H W"], *, radius: int) -> Bool[np.ndarray, "H W"]:
    """Opening (erosion, then dilation) by a square of 2 ``radius`` + 1 pixels a side: drops what no square fits in."""
    return ndimage.binary_dilation(erode(mask, radius=radius), _square(radius))


def _square(radius: int) -> Bool[np.ndarray, "k k"]:
    return np.ones((2 * radius + 1,) * 2, bool)
