"""fused pair, clusters -> corresponding points, in crop pixels."""

from __future__ import annotations

from typing import Protocol

from pipeline.items.features import Clusters, FusedPair
from pipeline.items.matches import Correspondences
from pipeline.spec import Variant


class Corresponder(Variant, Protocol):
    """What a correspond variant is. ``crop_size``: side S of the crops in pixels."""

    def __call__(self, pair: FusedPair, clusters: Clusters, *, crop_size: int) -> Correspondences:
        """Matched points, best first within a cluster. Raises NoPose when there is none."""
        ...
