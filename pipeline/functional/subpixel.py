"""Sub-cell positions from the similarities in a cell's neighbourhood."""

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
    subtract_own: bool = True,
) -> Float[Tensor, "m 2"]:
    """Shift (x, y), in cells, from the centres of template cells (flat indices) to where the query feature fits best.

    Similarity-weighted mean of the offsets in the ``kernel`` x ``kernel`` neighbourhood (von Gimborn et al., last
    equation of the method), not rounded. Features have unit length; weights are max(cosine, 0); neighbours outside the
    mask have weight 0. ``subtract_own``, a departure from the paper: the shift computed for the template cell's own
    feature, which should be 0, is subtracted. Otherwise points near silhouettes move inwards, and a perfect match by a
    tenth of a cell.
    """
    offset, index, valid = _neighbourhoods(mask, cell, kernel=kernel)
    flat = template.flatten(0, 1)
    neighbours = flat.index_select(0, index.flatten()).unflatten(0, index.shape)
    shift = _mean_offset(query, neighbours, valid, offset)
    if not subtract_own:
        return shift
    return shift - _mean_offset(flat.index_select(0, cell), neighbours, valid, offset)


def _mean_offset(
    feature: Float[Tensor, "m c"],
    neighbours: Float[Tensor, "m k c"],
    valid: Bool[Tensor, "m k"],
    offset: Float[Tensor, "k 2"],
) -> Float[Tensor, "m 2"]:
    """Mean offset (x, y), in cells, weighted by the neighbours' positive cosines with the feature; 0 if all are 0."""
    weight = (neighbours * feature[:, None]).sum(-1).clamp(min=0) * valid
    return weight @ offset / weight.sum(1, keepdim=True).clamp(min=torch.finfo(weight.dtype).tiny)


def _neighbourhoods(
    mask: Bool[Tensor, "h w"], cell: Int[Tensor, " m"], *, kernel: int
) -> tuple[Float[Tensor, "k 2"], Int[Tensor, "m k"], Bool[Tensor, "m k"]]:
    """Offsets (x, y) in row-major order, flat indices of the neighbours (clamped to the map), and which are valid."""
    h, w = mask.shape
    step = torch.arange(kernel, device=cell.device) - kernel // 2
    dy, dx = (d.flatten() for d in torch.meshgrid(step, step, indexing="ij"))
    y, x = cell[:, None] // w + dy, cell[:, None] % w + dx
    index = y.clamp(0, h - 1) * w + x.clamp(0, w - 1)
    inside = (y >= 0) & (y < h) & (x >= 0) & (x < w) & mask.flatten()[index]
    return torch.stack([dx, dy], 1).float(), index, inside
