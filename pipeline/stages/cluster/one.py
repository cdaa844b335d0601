"""fused pair -> one cluster that holds the whole foreground."""

from __future__ import annotations

from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.items.features import ClusteredMap, Clusters
from pipeline.spec import spec
from pipeline.stages.cluster import Clusterer


@spec
class One(Clusterer):
    """Clustering off: any cell of the query may match any cell of the template."""

    kind: ClassVar[str] = "cluster.one"
    version: ClassVar[int] = 1

    def encode(self, features: Float[Tensor, "d h w"], mask: Bool[Tensor, "h w"]) -> ClusteredMap:
        """Label 0 inside the mask; its centre is not used and has no dimensions."""
        return ClusteredMap(mask.long() - 1, features.new_zeros(1, 0))

    def pair(self, query: ClusteredMap, template: ClusteredMap) -> Clusters:
        """The two clusters correspond."""
        both = torch.zeros(1, 2, dtype=torch.int64, device=query.label.device)
        return Clusters(query.label, template.label, both)
