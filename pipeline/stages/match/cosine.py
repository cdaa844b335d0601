"""query features, template bank -> the templates with the most similar whole feature map."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from pipeline.functional.similarity import global_cosine, joint_cosine, map_norms
from pipeline.items.features import CLASS_FACET_LAYER
from pipeline.items.matches import TemplateMatch
from pipeline.items.online import Query, TemplateBank
from pipeline.spec import NonNegative, Positive, spec
from pipeline.stages.match import Matcher, rank


@spec
class Cosine(Matcher):
    """Cosine similarity of flattened feature maps (von Gimborn et al., "Template Matching", first equation).

    The maps include the background: it is black in both, and its shape is that of the silhouette. ``class_token``: the
    class token's key, query or value in the last block is one more cell of both, as in ZS6D's code (Ausserlechner et
    al., ICRA 2024), which compares the last block.
    """

    kind: ClassVar[str] = "match.cosine"
    version: ClassVar[int] = 1
    added: ClassVar[Mapping[str, Any]] = {"class_token": False}

    layer: NonNegative = 2
    top_k: Positive = 1
    class_token: bool = False

    @property
    def layers(self) -> tuple[int, ...]:
        """``layer``, and the class token's where it is compared."""
        return (self.layer, CLASS_FACET_LAYER) if self.class_token else (self.layer,)

    def __call__(self, query: Query, bank: TemplateBank) -> TemplateMatch:
        """The ``top_k`` best templates. Raises NoPose when the query's features are all zero or not finite."""
        if not self.class_token:
            return rank(global_cosine(query.crop.maps[self.layer], bank.features, norm=bank.norms), top_k=self.top_k)
        token = bank.maps(CLASS_FACET_LAYER)
        maps = [query.crop.maps[layer] for layer in self.layers]
        score = joint_cosine(maps, [bank.features, token], norms=[bank.norms, map_norms(token)])
        return rank(score, top_k=self.top_k)
