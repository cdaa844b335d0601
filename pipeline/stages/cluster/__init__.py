"""fused pair -> clusters of both sides and which of them correspond."""

from __future__ import annotations

from typing import Protocol

from pipeline.items.features import Clusters, FusedPair
from pipeline.spec import Variant


class Clusterer(Variant, Protocol):
    """What a cluster variant is."""

    def __call__(self, pair: FusedPair) -> Clusters:
        """Labels and matched pairs. Raises NoPose when no pair is left."""
        ...
