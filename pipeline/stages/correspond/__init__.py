"""fused pair, clusters -> corresponding points, in crop pixels."""

from __future__ import annotations

from typing import ClassVar, Protocol, runtime_checkable

from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.items.features import Clusters, FusedPair
from pipeline.items.matches import Correspondences
from pipeline.spec import Variant


class Corresponder(Variant, Protocol):
    """What a correspond variant is. ``crop_size``: side S of the crops in pixels."""

    def __call__(self, pair: FusedPair, clusters: Clusters, *, crop_size: int) -> Correspondences:
        """Matched points, best first within a cluster. Raises NoPose when there is none."""
        ...


@runtime_checkable
class TruthCorresponder(Protocol):
    """An oracle that is told where points truly lie; no other corresponder is."""

    needs_truth: ClassVar[bool]

    def by_truth(
        self, template_px: Float[Tensor, "m 2"], true_px: Float[Tensor, "m 2"], query_mask: Bool[Tensor, "S S"]
    ) -> Correspondences:
        """The pairs that both see."""
        ...
