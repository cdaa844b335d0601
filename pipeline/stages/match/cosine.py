"""query features, template bank -> the templates whose whole feature map points the same way."""

from __future__ import annotations

from collections.abc import MutableMapping
from typing import ClassVar

from jaxtyping import Bool, Float
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from pipeline.functional.similarity import global_cosine, map_norms
from pipeline.items.matches import TemplateMatch
from pipeline.spec import NonNegative, Positive, Spec, spec
from pipeline.stages.match import ranked


@spec
class Cosine(Spec):
    """Cosine similarity of flattened feature maps (von Gimborn et al., "Template Matching", first equation).

    Backgrounds are part of the maps: both are black, and where they are says what the silhouette is.
    """

    kind: ClassVar[str] = "match.cosine"
    version: ClassVar[int] = 1

    layer: NonNegative = 2
    top_k: Positive = 1

    def __call__(
        self,
        query: Float[Tensor, "c h w"],
        query_mask: Bool[Tensor, "S S"],
        bank: Float[Tensor, "n c h w"],
        bank_mask: Bool[Tensor, "n S S"],
    ) -> TemplateMatch:
        """The ``top_k`` best templates. Raises NoPose when the query's features are all zero or not finite."""
        return ranked(global_cosine(query, bank, norm=_norms(bank)), top_k=self.top_k)


_NORMS: MutableMapping[Tensor, tuple[int, Tensor]] = WeakTensorKeyDictionary()
"""Of the banks in use, by identity, with the count of changes in place: an object's many queries share its norms."""


def _norms(bank: Float[Tensor, "n c h w"]) -> Float[Tensor, " n"]:
    version, norms = _NORMS.get(bank, (-1, None))
    if norms is None or version != bank._version:
        norms = map_norms(bank)
        _NORMS[bank] = bank._version, norms
    return norms
