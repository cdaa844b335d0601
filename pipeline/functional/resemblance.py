"""crops of regions, templates -> how much each region resembles an object, by features and by colours."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from pipeline.functional.maps import normalize_channels
from pipeline.functional.similarity import l2_normalize

_STEP = 4  # every fourth pixel of a crop is enough for its colours
_DARK = 12.0  # grey levels added before logarithms: chroma of dark pixels is noise
_AXES = ((-1.2, 1.2, 0.1, 0.15), (-1.2, 1.2, 0.1, 0.15), (2.4, 5.7, 0.3, 0.6))
"""Lowest and highest value, width of the bins and of the kernel: log red/green, log blue/green, mean log brightness."""


def best_masked_cosine(
    maps: Float[Tensor, "q c h w"],
    mask: Bool[Tensor, "q h w"],
    template_maps: Float[Tensor, "n c h w"],
    template_mask: Bool[Tensor, "n h w"],
) -> Float[Tensor, " q"]:
    """Each map's highest similarity to a template: cosines of the cells inside both masks over cells inside either."""
    query, bank = _flat_cells(maps, mask), _flat_cells(template_maps, template_mask)
    inside, inside_bank = mask.flatten(1).float(), template_mask.flatten(1).float()
    union = inside.sum(1, keepdim=True) + inside_bank.sum(1) - inside @ inside_bank.T
    return (query @ bank.T / union.clamp(min=1)).amax(1)


def _flat_cells(maps: Float[Tensor, "n c h w"], mask: Bool[Tensor, "n h w"]) -> Float[Tensor, "n d"]:
    """Cells scaled to length 1, those outside the mask 0, as one vector."""
    return (normalize_channels(maps.float()) * mask[:, None]).flatten(1)


def colour_profile(rgb: UInt8[np.ndarray, "n S S 3"], mask: Bool[np.ndarray, "n S S"]) -> Float[Tensor, "n b"]:
    """Each crop's histogram of the colours inside its mask, smoothed: similar distributions have a small distance.

    The scalar product of two profiles is the mean of a Gaussian kernel over all pairs of their pixels, at most 1. The
    kernel is wide along brightness, since light and exposure differ, and narrow along chroma.
    """
    values = np.log(rgb[:, ::_STEP, ::_STEP].astype(np.float32) + _DARK)
    green = values[..., 1]
    colours = (values[..., 0] - green, values[..., 2] - green, values.mean(-1))
    counts = [round((high - low) / step) + 1 for low, high, step, _ in _AXES]
    code = np.zeros(green.shape, np.int64)
    for colour, count, (low, _, step, _) in zip(colours, counts, _AXES, strict=True):
        code = code * count + np.rint((colour - low) / step).astype(np.int64).clip(0, count - 1)
    inside, bins = mask[:, ::_STEP, ::_STEP], int(np.prod(counts))
    histograms = np.stack([np.bincount(c[m], minlength=bins) for c, m in zip(code, inside, strict=True)])
    shares = torch.from_numpy(histograms / np.maximum(histograms.sum(1, keepdims=True), 1)).float()
    smooth = [_kernel(count, step, width) for count, (_, _, step, width) in zip(counts, _AXES, strict=True)]
    return torch.einsum("nijk,ia,jb,kc->nabc", shares.view(-1, *counts), *smooth).flatten(1)


def best_colour_match(profiles: Float[Tensor, "q b"], templates: Float[Tensor, "n b"]) -> Float[Tensor, " q"]:
    """Each profile's similarity to the nearest of the templates: 1 for equal ones, 0 for nothing in common."""
    return 1 - torch.cdist(profiles, templates).amin(1) / math.sqrt(2)


def _kernel(count: int, step: float, width: float) -> Float[Tensor, "b b"]:
    """Rows of length 1 whose scalar products are a Gaussian of this width over the distance of two bins."""
    distance = step * (torch.arange(count)[:, None] - torch.arange(count))
    return l2_normalize(torch.exp(-((distance / width) ** 2)))
