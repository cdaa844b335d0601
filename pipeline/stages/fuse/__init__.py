"""query and template features -> one map each, in a common space."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor

from pipeline.errors import NoPose
from pipeline.fits import Fit, Fitted
from pipeline.functional.masks import cell_mask, foreground
from pipeline.items.features import FusedPair
from pipeline.spec import NonNegative, Variant

Layers = Annotated[tuple[NonNegative, ...], Field(min_length=1)]


class Fuser(Variant, Protocol):
    """What a fuse variant is. ``layers``: the decoder layers it needs; masks are those of the crops (S S)."""

    layers: tuple[int, ...]

    def __call__(
        self,
        query: Mapping[int, Float[Tensor, "c h w"]],
        template: Mapping[int, Float[Tensor, "c h w"]],
        query_mask: Bool[Tensor, "S S"],
        template_mask: Bool[Tensor, "S S"],
    ) -> FusedPair:
        """Fused maps at the resolution of the finest layer. Raises NoPose when a mask has no cell."""
        ...


@runtime_checkable
class TrainedFuser(Protocol):
    """One that was trained on the features of one model."""

    def check(self, model: str) -> None:
        """Raise BadInput for features of another ``model`` (an extractor's)."""
        ...


@runtime_checkable
class SidedFuser(Protocol):
    """One whose map of a side depends on that side alone: a query's is made once for all its templates."""

    def side(self, features: Mapping[int, Float[Tensor, "c h w"]]) -> Float[Tensor, "d h w"]:
        """The map of one side."""
        ...


@runtime_checkable
class FittedFuser(Protocol):
    """A fuser that stands on something fitted to the object's templates."""

    @property
    def fit(self) -> Fit:
        """What it stands on."""
        ...

    def by_fitted(
        self,
        query: Mapping[int, Float[Tensor, "c h w"]],
        template: Mapping[int, Float[Tensor, "c h w"]],
        query_mask: Bool[Tensor, "S S"],
        template_mask: Bool[Tensor, "S S"],
        fitted: Fitted,
    ) -> FusedPair:
        """Fused maps. Raises NoPose when a mask has no cell."""
        ...


def finest(maps: Mapping[int, Float[Tensor, "c h w"]], layers: Sequence[int]) -> int:
    """Cells a side of the finest of the layers' maps."""
    return max(maps[layer].shape[-1] for layer in layers)


def samples(
    query: Float[Tensor, "c h w"],
    template: Float[Tensor, "c h w"],
    masks: tuple[Bool[Tensor, "S S"], Bool[Tensor, "S S"]] | None,
    *,
    layer: int,
) -> Float[Tensor, "m c"]:
    """Features of the cells inside the masks (None: of all cells), the query's first.

    Raises NoPose for an empty mask and for features that are not finite.
    """
    if masks is None:
        sides = [query.flatten(1), template.flatten(1)]
    else:
        inside = _cell_masks(*masks, cells=query.shape[-1])
        pairs = zip((query, template), inside, strict=True)
        sides = [side.flatten(1).index_select(1, foreground(mask)) for side, mask in pairs]
    both = torch.cat(sides, dim=1).T
    if not bool(torch.isfinite(both.sum(0)).all()):  # one value that is not finite makes its sum so
        raise NoPose("fuse", f"features of layer {layer} are not finite")
    return both


def fused(
    query: Float[Tensor, "d h w"],
    template: Float[Tensor, "d h w"],
    query_mask: Bool[Tensor, "S S"],
    template_mask: Bool[Tensor, "S S"],
    note: str = "",
) -> FusedPair:
    """The pair with its masks at the maps' resolution. Raises NoPose for an empty mask."""
    of_query, of_template = _cell_masks(query_mask, template_mask, cells=query.shape[-1])
    return FusedPair(query, template, of_query, of_template, note)


def _cell_masks(
    query_mask: Bool[Tensor, "S S"], template_mask: Bool[Tensor, "S S"], *, cells: int
) -> tuple[Bool[Tensor, "h w"], Bool[Tensor, "h w"]]:
    masks = cell_mask(query_mask, cells=cells), cell_mask(template_mask, cells=cells)
    for name, mask in zip(("query", "template"), masks, strict=True):
        if not mask.any():
            raise NoPose("fuse", f"{name} mask is empty, needs 1 pixel")
    return masks
