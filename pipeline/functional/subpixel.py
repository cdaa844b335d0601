"""Positions in between cells, from the similarities of a neighbourhood."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


def neighbourhood_shift(
    query: Float[Tensor, "m c"],
    template: Float[Tensor, "h w c"],
    mask: Bool[Tensor, "h w"],
    cell: Int[Tensor, " m"],
    *,
    kernel: int,
) -> Float[Tensor, "m 2"]:
    """Shift (x, y), in cells, from flat template cells towards where the query's features fit best.

    Similarity-weighted mean over the ``kernel`` x ``kernel`` neighbourhood (von Gimborn et al., last equation of the
    method), the fraction kept. Features are of unit length; weights are max(cosine, 0); only neighbours inside the
    mask count. Departure: the shift that the template cell's own feature would get, which ought to be 0, is
    subtracted. Without it silhouettes pull inwards, and a perfect match moves by a tenth of a cell.
    """
    offset, index, counts = _neighbourhoods(mask, cell, kernel=kernel)
    flat = template.flatten(0, 1)
    around, own = flat.index_select(0, index.flatten()).unflatten(0, index.shape), flat.index_select(0, cell)
    return _mean_offset(query, around, counts, offset) - _mean_offset(own, around, counts, offset)


def _mean_offset(
    feature: Float[Tensor, "m c"],
    around: Float[Tensor, "m k c"],
    counts: Bool[Tensor, "m k"],
    offset: Float[Tensor, "k 2"],
) -> Float[Tensor, "m 2"]:
    weight = (around @ feature[:, :, None])[..., 0].clamp(min=0) * counts
    return weight @ offset / weight.sum(1, keepdim=True).clamp(min=torch.finfo(weight.dtype).tiny)


def _neighbourhoods(
    mask: Bool[Tensor, "h w"], cell: Int[Tensor, " m"], *, kernel: int
) -> tuple[Float[Tensor, "k 2"], Int[Tensor, "m k"], Bool[Tensor, "m k"]]:
    """Offsets (x, y) in reading order, flat indices of the neighbours (clamped to the map), and which count."""
    h, w = mask.shape
    reach = torch.arange(kernel, device=cell.device) - kernel // 2
    dy, dx = (d.flatten() for d in torch.meshgrid(reach, reach, indexing="ij"))
    y, x = cell[:, None] // w + dy, cell[:, None] % w + dx
    index = y.clamp(0, h - 1) * w + x.clamp(0, w - 1)
    inside = (y >= 0) & (y < h) & (x >= 0) & (x < w) & mask.flatten()[index]
    return torch.stack([dx, dy], 1).float(), index, inside
