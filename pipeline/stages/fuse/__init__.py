"""query and template features -> one map each, in a common space."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.items.features import FusedPair


class Fuser(Protocol):
    """What a fuse variant is. ``layers``: the decoder layers it needs; masks are those of the crops (S S)."""

    layers: tuple[int, ...]

    def __call__(
        self,
        query: Mapping[int, Float[Tensor, "c h w"]],
        template: Mapping[int, Float[Tensor, "c h w"]],
        query_mask: Bool[Tensor, "S S"],
        template_mask: Bool[Tensor, "S S"],
    ) -> FusedPair:
        """Fused maps at the resolution of the finest layer. Raises NoPose when a mask has no cell."""
        ...
