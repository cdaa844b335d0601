"""query and template features -> one map each, in a common space."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import gcd
from typing import Annotated, Any, ClassVar, Generic, TypeVar

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor

from pipeline.backbones.extractor import Extractor
from pipeline.errors import NoPose
from pipeline.functional.maps import block_means
from pipeline.functional.masks import cell_mask, foreground
from pipeline.items.features import CropFeatures, FittedArrays, FusedPair
from pipeline.items.fit import Fit
from pipeline.items.online import Query, TemplateView
from pipeline.spec import NonNegative, Spec

Layers = Annotated[tuple[NonNegative, ...], Field(min_length=1)]
Encoded = TypeVar("Encoded")


@dataclass(frozen=True, eq=False)
class EncodedMap:
    """One image's fused map and its foreground cells. ``note``: what was clamped, "" for nothing."""

    features: Float[Tensor, "d h w"]
    mask: Bool[Tensor, "h w"]
    note: str = ""


class Fuser(Spec, ABC, Generic[Encoded]):
    """Contract of a fuse variant: ``encode`` runs once per image and is memoised, ``pair`` once per template match.

    ``layers``: the decoder layers it reads. ``joint``: True where a map of the pair depends on both images; then
    ``encode`` returns its input unchanged, and what is computed from such a map cannot be reused for another pair.
    """

    layers: tuple[int, ...]
    joint: ClassVar[bool] = False

    @property
    def fit(self) -> Fit | None:
        """A model fitted to the object's templates offline; None for none."""
        return None

    def check(self, extract: Extractor) -> None:
        """Raise BadInput if the variant was trained on features that this extractor does not give."""
        return

    def encoded_shape(self, shapes: Mapping[int, tuple[int, int, int]]) -> tuple[int, int, int] | None:
        """(d, h, w) of the map that ``encode`` makes of layers of these shapes; None: unknown, so it is not stored."""
        return None

    @abstractmethod
    def encode(self, crop: CropFeatures, fitted: FittedArrays) -> Encoded:
        """One image's input to ``pair``. ``fitted``: arrays of ``fit``, empty without one. Raises NoPose."""

    @abstractmethod
    def pair(self, query: Encoded, template: Encoded) -> FusedPair:
        """Fused maps at the resolution of the finest layer. Raises NoPose for a mask without a cell."""

    def __call__(self, query: CropFeatures, template: CropFeatures, fitted: FittedArrays | None = None) -> FusedPair:
        """Encode both images and pair them."""
        return self.pair(self.encode(query, fitted or {}), self.encode(template, fitted or {}))


def finest(maps: Mapping[int, Float[Tensor, "c h w"]], layers: Sequence[int]) -> int:
    """Cells per side of the finest of the layers' maps."""
    return max(maps[layer].shape[-1] for layer in layers)


def sample_cells(
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
        cells = [query.flatten(1), template.flatten(1)]
    else:
        inside = _mask_cells(*masks, cells=query.shape[-1])
        pairs = zip((query, template), inside, strict=True)
        cells = [features.flatten(1).index_select(1, foreground(mask)) for features, mask in pairs]
    both = torch.cat(cells, dim=1).T
    if not bool(torch.isfinite(both.sum(0)).all()):  # the sum is finite only if every value is
        raise NoPose("fuse", f"features of layer {layer} are not finite")
    return both


def pair_maps(
    query: Float[Tensor, "d h w"],
    template: Float[Tensor, "d h w"],
    query_mask: Bool[Tensor, "S S"],
    template_mask: Bool[Tensor, "S S"],
    note: str = "",
) -> FusedPair:
    """The maps with the crops' masks brought to their resolution. Raises NoPose for an empty mask."""
    masks = _mask_cells(query_mask, template_mask, cells=query.shape[-1])
    return FusedPair(query, template, *masks, note)


def pair_encoded(query: EncodedMap, template: EncodedMap) -> FusedPair:
    """Two maps that were encoded independently. Raises NoPose for a mask without a cell."""
    _require_cells(query.mask, template.mask)
    return FusedPair(query.features, template.features, query.mask, template.mask, query.note)


def encode_view(
    view: Query | TemplateView, fuse: Fuser[Any], fitted: Callable[[Fit], FittedArrays], *, block: int
) -> Any:
    """One image's map, encoded once or, for a template's coarse map, read; coarser maps are made from it."""
    if block > 1:
        stored = view.read_encoding if isinstance(view, TemplateView) else None
        make = stored or (lambda: coarsen(encode_view(view, fuse, fitted, block=1), block=block))
        return view.memo.get((fuse, block), make)
    return view.memo.get(fuse, lambda: fuse.encode(view.crop, {} if fuse.fit is None else fitted(fuse.fit)))


def coarse_shape(shape: tuple[int, int, int], *, block: int) -> tuple[int, int, int]:
    """(d, h, w) of a map of this shape after ``coarsen``."""
    d, h, w = shape
    block = gcd(block, w)
    return d, h // block, w // block


def coarsen(encoded: EncodedMap, *, block: int) -> EncodedMap:
    """The map of the mean features of blocks of cells; the largest divisor of its side that divides ``block``."""
    block = gcd(block, encoded.features.shape[-1])
    if block == 1:
        return encoded
    features, mask = block_means(encoded.features, encoded.mask, block=block)
    return EncodedMap(features, mask, encoded.note)


def coarsen_pair(pair: FusedPair, *, block: int) -> FusedPair:
    """As ``coarsen``, for both maps of a pair."""
    query = coarsen(EncodedMap(pair.query, pair.query_mask), block=block)
    template = coarsen(EncodedMap(pair.template, pair.template_mask), block=block)
    return FusedPair(query.features, template.features, query.mask, template.mask, pair.note)


def _mask_cells(
    query_mask: Bool[Tensor, "S S"], template_mask: Bool[Tensor, "S S"], *, cells: int
) -> tuple[Bool[Tensor, "h w"], Bool[Tensor, "h w"]]:
    masks = cell_mask(query_mask, cells=cells), cell_mask(template_mask, cells=cells)
    _require_cells(*masks)
    return masks


def _require_cells(query_mask: Bool[Tensor, "h w"], template_mask: Bool[Tensor, "h w"]) -> None:
    for name, mask in (("query", query_mask), ("template", template_mask)):
        if not mask.any():
            raise NoPose("fuse", f"{name} mask is empty, needs 1 pixel")
