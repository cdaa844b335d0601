"""Feature maps: resampling, scaling and concatenation."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate, normalize


def upsample(features: Float[Tensor, "c h w"], *, cells: int) -> Float[Tensor, "c cells_y cells_x"]:
    """Map resampled bilinearly to ``cells`` x ``cells``; the borders coincide (align_corners=False)."""
    if features.shape[-1] == cells:
        return features
    return interpolate(features[None], size=(cells, cells), mode="bilinear", align_corners=False)[0]


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
