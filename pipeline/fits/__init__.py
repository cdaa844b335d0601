"""template features -> arrays fitted to one object, computed once offline for the stages that need them."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.functional.masks import cell_mask
from pipeline.items.features import FittedArrays, TemplateCells
from pipeline.items.fit import Fit


def chain(fit: Fit) -> tuple[Fit, ...]:
    """The fit after all the fits that it is based on."""
    return (*(chain(fit.base) if fit.base is not None else ()), fit)


def fit_arrays(fit: Fit, cells: TemplateCells) -> FittedArrays:
    """Arrays of a fit and of its bases, computed without a store."""
    arrays: dict[str, Tensor] = {}
    for part in chain(fit):
        arrays |= part(cells, arrays)
    return arrays


def foreground_cells(maps: Float[Tensor, "n c h w"], mask: Bool[Tensor, "n S S"]) -> TemplateCells:
    """Features of the foreground cells of n templates."""
    inside = cell_mask(mask, cells=maps.shape[-1])
    return TemplateCells(maps.movedim(1, -1)[inside], torch.nonzero(inside)[:, 0], len(maps))
