"""fused pair -> clusters of both sides and which of them correspond."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.items.features import Clusters, FusedPair
from pipeline.spec import Variant


@dataclass(frozen=True, eq=False)
class Side:
    """One side's clusters: the label of each foreground cell (-1: background), and the centre of each cluster."""

    label: Int[Tensor, "h w"]
    centre: Float[Tensor, "k d"]


class Clusterer(Variant, Protocol):
    """What a cluster variant is."""

    def __call__(self, pair: FusedPair) -> Clusters:
        """Labels and matched pairs. Raises NoPose when no pair is left."""
        ...


@runtime_checkable
class SidedClusterer(Protocol):
    """One whose clusters of a side depend on that side alone: those of a map met before are found once."""

    def side(self, name: str, features: Float[Tensor, "d h w"], mask: Bool[Tensor, "h w"]) -> Side:
        """Clusters of the side called ``name``. Raises NoPose for a mask without a cell."""
        ...

    def paired(self, query: Side, template: Side) -> Clusters:
        """Which clusters correspond. Raises NoPose when no pair is left."""
        ...
