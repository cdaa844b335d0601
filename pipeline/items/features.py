"""Feature maps of crops, by decoder layer, and the fused maps of a query and its template."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor

FeatureMaps = Mapping[int, Float[Tensor, "n _c _h _w"]]
"""layer -> maps of n crops. A layer's map covers the whole crop with h x w equal cells; c, h, w depend on the layer."""

SALIENCY_LAYER = -1
"""Where a transformer gives the class token's attention, (1 h w): an extractor that has none knows no such layer."""

CLASS_TOKEN_LAYER = -2
"""Where a transformer gives its class token, (c 1 1)."""

PSEUDO_LAYERS = f"{SALIENCY_LAYER} (saliency) or {CLASS_TOKEN_LAYER} (class token)"
"""Both, as messages name them."""


@dataclass(frozen=True, eq=False)
class FusedPair:
    """Query and template in one feature space, at the resolution of the finest layer.

    ``note`` says what was clamped or skipped, "" when nothing was. Saliency, 0 to 1, is there for those who need it.
    """

    query: Float[Tensor, "d h w"]
    template: Float[Tensor, "d h w"]
    query_mask: Bool[Tensor, "h w"]
    template_mask: Bool[Tensor, "h w"]
    note: str = ""
    query_saliency: Float[Tensor, "h w"] | None = None
    template_saliency: Float[Tensor, "h w"] | None = None


@dataclass(frozen=True, eq=False)
class Clusters:
    """Cluster of each foreground cell (-1: background) in query and template, and which clusters correspond."""

    query_label: Int[Tensor, "h w"]
    template_label: Int[Tensor, "h w"]
    pairs: Int[Tensor, "p 2"]
    note: str = ""


@dataclass(frozen=True, eq=False)
class TemplateCells:
    """Features of one layer in all foreground cells of an object's n templates. ``template``: which one each is of."""

    features: Float[Tensor, "m c"]
    template: Int[Tensor, " m"]
    templates: int
