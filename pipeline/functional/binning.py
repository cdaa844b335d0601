"""Log-binned context for each cell of a map: nearby cells one by one, distant ones as means."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d


def bin_count(hierarchy: int) -> int:
    """Number of bins per cell: the cell itself and 8 neighbours on every level."""
    return 1 + 8 * hierarchy


def log_bin(maps: Float[Tensor, "n c h w"], *, hierarchy: int) -> Float[Tensor, "n d h w"]:
    """Each cell's features concatenated with its spatial bins, d = (1 + 8 ``hierarchy``) c.

    Level k holds means over 3^k x 3^k cells, centred 3^k cells away in 8 directions; level 0 adds the cell itself.
    Means ignore cells outside the map; bin centres outside it are clamped to the border. Source: Amir et al., ECCVW
    2022, Sec. 3, and their code.
    """
    bins = []
    for level in range(hierarchy):
        step = 3**level
        means = avg_pool2d(maps, step, stride=1, padding=step // 2, count_include_pad=False)
        shifts = [(i, j) for i in (-step, 0, step) for j in (-step, 0, step)]
        bins += [_shift(means, i, j) for i, j in shifts if level == 0 or (i, j) != (0, 0)]
    return torch.cat(bins, dim=1)


def _shift(maps: Float[Tensor, "n c h w"], rows: int, columns: int) -> Float[Tensor, "n c h w"]:
    """The value ``rows`` down and ``columns`` right of each cell, clamped to the border."""
    h, w = maps.shape[2:]
    i = (torch.arange(h, device=maps.device) + rows).clamp(0, h - 1)
    j = (torch.arange(w, device=maps.device) + columns).clamp(0, w - 1)
    return maps[:, :, i[:, None], j]
