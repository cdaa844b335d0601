"""Feature maps of crops, by decoder layer, and the fused maps of a query and a template."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from torch import Tensor

FeatureMaps = Mapping[int, Float[Tensor, "n _c _h _w"]]
"""layer -> maps of n crops. A layer's map covers the whole crop with h x w equal cells; c, h, w depend on the layer."""

FittedArrays = Mapping[str, Tensor]
"""Arrays of a fit to an object's templates by name, those of its base included (pipeline.fits)."""

SALIENCY_LAYER = -1
"""Pseudo-layer of vision transformers: the class token's attention to each patch, (1 h w)."""

CLASS_TOKEN_LAYER = -2
"""Pseudo-layer of vision transformers: the class token, (c 1 1)."""

CLASS_FACET_LAYER = -3
"""Pseudo-layer of vision transformers: key, query or value of the class token in the last block, (c 1 1)."""

PSEUDO_LAYERS = (
    f"{SALIENCY_LAYER} (saliency), {CLASS_TOKEN_LAYER} (class token) or {CLASS_FACET_LAYER} (its key, query or value)"
)
"""All of them, as messages name them."""


@dataclass(frozen=True, eq=False)
class CropFeatures:
    """Features of one crop by layer, and the mask of the object in the crop."""

    maps: Mapping[int, Float[Tensor, "c h w"]]
    mask: Bool[Tensor, "S S"]


@dataclass(frozen=True, eq=False)
class FusedPair:
    """Query and template in one feature space, at the resolution of the finest layer.

    ``note`` says what was clamped or skipped ("" for nothing). Saliency, 0 to 1, is set where a corresponder needs it.
    """

    query: Float[Tensor, "d h w"]
    template: Float[Tensor, "d h w"]
    query_mask: Bool[Tensor, "h w"]
    template_mask: Bool[Tensor, "h w"]
    note: str = ""
    query_saliency: Float[Tensor, "h w"] | None = None
    template_saliency: Float[Tensor, "h w"] | None = None


@dataclass(frozen=True, eq=False)
class PairGeometry:
    """A fused pair, and what places the template's cells in the query under a pose: input of scoring and refinement.

    ``points_obj``: object points (mm) at the centres of the template's foreground cells in reading order, NaN off the
    object. ``K_crop`` = A_crop_img K of the query takes the camera frame to crop pixels, ``crop_size`` of them a side.
    """

    pair: FusedPair
    points_obj: Float[np.ndarray, "m 3"]
    K_crop: Float[np.ndarray, "3 3"]
    crop_size: int


@dataclass(frozen=True, eq=False)
class ClusteredMap:
    """Clusters of one fused map: the label of each foreground cell (-1: background), and the centre of each cluster."""

    label: Int[Tensor, "h w"]
    centre: Float[Tensor, "k d"]


@dataclass(frozen=True, eq=False)
class Clusters:
    """Cluster of each foreground cell (-1: background) in query and template, and which clusters correspond."""

    query_label: Int[Tensor, "h w"]
    template_label: Int[Tensor, "h w"]
    pairs: Int[Tensor, "p 2"]
    note: str = ""


@dataclass(frozen=True, eq=False)
class TemplateCells:
    """Features of one layer in the foreground cells of an object's templates, and the template each cell is in."""

    features: Float[Tensor, "m c"]
    template: Int[Tensor, " m"]
    templates: int
