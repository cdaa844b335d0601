"""template features -> what is learned of one object, offline and once, for the stages that stand on it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.functional.masks import cell_mask
from pipeline.items.features import TemplateCells
from pipeline.spec import Variant

Fitted = Mapping[str, Tensor]
"""Arrays by name, those of the fit's base among them."""


class Fit(Variant, Protocol):
    """What is learned of an object's templates: a spec of its own, so that it is stored by what it depends on alone.

    A variant of a stage that needs one says so by a property ``fit``, and is given its arrays where it is called; two
    variants with equal fits share one entry.
    """

    def __hash__(self) -> int:
        """Fits are frozen: equal ones are one."""
        ...

    @property
    def layer(self) -> int:
        """Whose features it is fitted to."""
        ...

    @property
    def base(self) -> Fit | None:
        """The fit that this one stands on, of the same layer, if any."""
        ...

    def array_bytes(self, channels: int, templates: int) -> int:
        """What its own arrays take at most, for features of so many channels."""
        ...

    def __call__(self, cells: TemplateCells, base: Fitted) -> dict[str, Tensor]:
        """Its own arrays, on the CPU, the same every time. Raises DzopError for features it cannot be fitted to."""
        ...


def chain(fit: Fit) -> tuple[Fit, ...]:
    """The fit and all it stands on, those first."""
    return (*(chain(fit.base) if fit.base is not None else ()), fit)


def fitted_to(fit: Fit, cells: TemplateCells) -> Fitted:
    """Arrays of a fit and of all it stands on, without a store."""
    arrays: dict[str, Tensor] = {}
    for part in chain(fit):
        arrays |= part(cells, arrays)
    return arrays


def foreground_cells(maps: Float[Tensor, "n c h w"], mask: Bool[Tensor, "n S S"]) -> TemplateCells:
    """The foreground of n templates."""
    inside = cell_mask(mask, cells=maps.shape[-1])
    return TemplateCells(maps.movedim(1, -1)[inside], torch.nonzero(inside)[:, 0], len(maps))
