"""query and template features -> one map each, layers side by side without a projection."""

from __future__ import annotations

from typing import ClassVar

import torch

from pipeline.functional.maps import root_mean_square_norm, upsample
from pipeline.items.features import CropFeatures, FittedArrays, FusedPair
from pipeline.spec import spec
from pipeline.stages.fuse import Fuser, Layers, finest, pair_maps, sample_cells


@spec
class Concat(Fuser[CropFeatures]):
    """The paper's ablation of the co-projection: upsampled and concatenated, thousands of channels.

    ``normalise`` divides each layer by the root mean square length of the foreground cells of both images, as
    ``fuse=pca`` does, so that the ablation changes nothing but the projection.
    """

    kind: ClassVar[str] = "fuse.concat"
    version: ClassVar[int] = 1
    joint: ClassVar[bool] = True

    layers: Layers = (2, 5, 8, 11)
    normalise: bool = True

    def encode(self, crop: CropFeatures, fitted: FittedArrays) -> CropFeatures:
        """The crop's features, unchanged: the scale of a layer depends on both images."""
        return crop

    def pair(self, query: CropFeatures, template: CropFeatures) -> FusedPair:
        """Fused maps. Raises NoPose for an empty mask."""
        cells = finest(query.maps, self.layers)
        query_maps, template_maps = [], []
        for layer in self.layers:
            q, t = query.maps[layer].float(), template.maps[layer].float()
            sampled = sample_cells(q, t, (query.mask, template.mask), layer=layer)
            norm = root_mean_square_norm(sampled) if self.normalise else 1.0
            query_maps.append(upsample(q / norm, cells=cells))
            template_maps.append(upsample(t / norm, cells=cells))
        return pair_maps(torch.cat(query_maps), torch.cat(template_maps), query.mask, template.mask)
