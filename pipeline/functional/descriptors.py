"""One descriptor per crop, and its similarity to an object with many templates."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.functional.masks import cell_mask
from pipeline.functional.similarity import l2_normalize


def pool_foreground(maps: Float[Tensor, "n c h w"], mask: Bool[Tensor, "n S S"]) -> Float[Tensor, "n c"]:
    """Mean feature over each crop's foreground cells; zeros for a crop with an empty mask.

    A map of one cell, such as a class token, is returned as that cell.
    """
    inside = cell_mask(mask, cells=maps.shape[-1]).float()
    total = torch.einsum("nchw,nhw->nc", maps.float(), inside)
    return total / inside.sum((1, 2)).clamp(min=1)[:, None]


def mean_top_cosine(query: Float[Tensor, "p c"], templates: Float[Tensor, "n c"], *, best: int) -> Float[Tensor, " p"]:
    """Mean of each query's ``best`` highest cosines with the templates (of all if there are fewer).

    Negative cosines count as 0. Source: Nguyen et al., "CNOS", ICCVW 2023, section 3.3, with ``best`` = 5.
    """
    cosine = (l2_normalize(query) @ l2_normalize(templates).T).clamp(0, 1)
    return cosine.topk(min(best, len(templates)), dim=1).values.mean(1)
