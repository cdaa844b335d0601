"""query features, template bank -> the templates that look most alike."""

from __future__ import annotations

from typing import Protocol

from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.items.matches import TemplateMatch


class Matcher(Protocol):
    """What a match variant is. ``layer``: the decoder layer it compares; masks are those of the crops (S S)."""

    layer: int

    def __call__(
        self,
        query: Float[Tensor, "c h w"],
        query_mask: Bool[Tensor, "S S"],
        bank: Float[Tensor, "n c h w"],
        bank_mask: Bool[Tensor, "n S S"],
    ) -> TemplateMatch:
        """The best templates of one query. Raises NoPose when nothing can be compared."""
        ...
