"""fused pair -> clusters of query and template, and which of them correspond."""

from __future__ import annotations

from abc import ABC, abstractmethod

from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.errors import NoPose
from pipeline.items.features import ClusteredMap, Clusters, FusedPair
from pipeline.spec import Spec


class Clusterer(Spec, ABC):
    """Contract of a cluster variant: ``encode`` clusters one map, ``pair`` matches the clusters of two."""

    @abstractmethod
    def encode(self, features: Float[Tensor, "d h w"], mask: Bool[Tensor, "h w"]) -> ClusteredMap:
        """Clusters of the foreground cells, of which there is at least one."""

    @abstractmethod
    def pair(self, query: ClusteredMap, template: ClusteredMap) -> Clusters:
        """Which clusters correspond. Raises NoPose when no pair is left."""

    def __call__(self, pair: FusedPair) -> Clusters:
        """Cluster both maps and match. Raises NoPose for a mask without a cell and when no pair is left."""
        require_cells(pair)
        query = self.encode(pair.query, pair.query_mask)
        return self.pair(query, self.encode(pair.template, pair.template_mask))


def require_cells(pair: FusedPair) -> None:
    """Raise NoPose for a mask without a cell."""
    for name, mask in (("query", pair.query_mask), ("template", pair.template_mask)):
        if not mask.any():
            raise NoPose("cluster", f"{name} mask has no cell")
