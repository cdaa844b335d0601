"""query and template features -> one map each, projected onto the principal axes of the object's templates."""

from __future__ import annotations

from typing import Annotated, ClassVar

import torch
from pydantic import Field

from pipeline.errors import NoPose
from pipeline.fits.projection import Projection, project_map
from pipeline.functional.masks import cell_mask
from pipeline.items.features import CropFeatures, FittedArrays, FusedPair
from pipeline.spec import NonNegative, Positive, spec
from pipeline.stages.fuse import EncodedMap, Fuser, pair_encoded


@spec
class TemplatePca(Fuser[EncodedMap]):
    """One layer, projected by a PCA that was fitted offline to the foreground of all templates of the object.

    Örnek et al., "FoundPose", ECCV 2024, section 3.1. Unlike fuse=pca, all pairs of an object share one space and no
    decomposition runs online. ``layers`` names a single layer.
    """

    kind: ClassVar[str] = "fuse.template_pca"
    version: ClassVar[int] = 1

    layers: Annotated[tuple[NonNegative, ...], Field(min_length=1, max_length=1)] = (11,)
    dim: Positive = 256

    @property
    def fit(self) -> Projection:
        """The axes."""
        return Projection(layer=self.layers[0], dim=self.dim)

    def encode(self, crop: CropFeatures, fitted: FittedArrays) -> EncodedMap:
        """The projected map; ``note`` is set if the templates span fewer dimensions than ``dim``.

        Raises NoPose for features that are not finite.
        """
        layer, dim = self.layers[0], fitted["axes"].shape[1]
        if not bool(torch.isfinite(crop.maps[layer]).all()):
            raise NoPose("fuse", f"features of layer {layer} are not finite")
        features = project_map(crop.maps[layer], fitted)
        note = f"layer {layer}: {dim} of {self.dim} dimensions, the templates span no more" if dim < self.dim else ""
        return EncodedMap(features, cell_mask(crop.mask, cells=features.shape[-1]), note)

    def pair(self, query: EncodedMap, template: EncodedMap) -> FusedPair:
        """Fused maps. Raises NoPose for an empty mask."""
        return pair_encoded(query, template)
