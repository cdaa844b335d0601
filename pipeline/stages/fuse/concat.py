"""query and template features -> one map each, layers side by side without a projection."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.functional.maps import root_mean_square_norm, upsample
from pipeline.items.features import FusedPair
from pipeline.spec import Spec, spec
from pipeline.stages.fuse import Layers, finest, fused, samples


@spec
class Concat(Spec):
    """The paper's ablation of the co-projection: upsampled and concatenated, thousands of channels.

    ``normalise`` divides each layer by the root mean square length of the foreground cells of both, as ``fuse=pca``
    does, so that the ablation changes the projection alone.
    """

    kind: ClassVar[str] = "fuse.concat"
    version: ClassVar[int] = 1

    layers: Layers = (2, 5, 8, 11)
    normalise: bool = True

    def __call__(
        self,
        query: Mapping[int, Float[Tensor, "c h w"]],
        template: Mapping[int, Float[Tensor, "c h w"]],
        query_mask: Bool[Tensor, "S S"],
        template_mask: Bool[Tensor, "S S"],
    ) -> FusedPair:
        """Fused maps. Raises NoPose for an empty mask."""
        cells = finest(query, self.layers)
        blocks = []
        for layer in self.layers:
            q, t = query[layer].float(), template[layer].float()
            sampled = samples(q, t, (query_mask, template_mask), layer=layer)
            norm = root_mean_square_norm(sampled) if self.normalise else 1.0
            blocks.append([upsample(side / norm, cells=cells) for side in (q, t)])
        query_map, template_map = (torch.cat(side) for side in zip(*blocks, strict=True))
        return fused(query_map, template_map, query_mask, template_mask)
