"""query features, template bank -> the templates with the most similar whole feature map."""

from __future__ import annotations

from typing import ClassVar

from pipeline.functional.similarity import global_cosine
from pipeline.items.matches import TemplateMatch
from pipeline.items.online import Query, TemplateBank
from pipeline.spec import NonNegative, Positive, spec
from pipeline.stages.match import Matcher, rank


@spec
class Cosine(Matcher):
    """Cosine similarity of flattened feature maps (von Gimborn et al., "Template Matching", first equation).

    The maps include the background: it is black in both, and its shape is that of the silhouette.
    """

    kind: ClassVar[str] = "match.cosine"
    version: ClassVar[int] = 1

    layer: NonNegative = 2
    top_k: Positive = 1

    def __call__(self, query: Query, bank: TemplateBank) -> TemplateMatch:
        """The ``top_k`` best templates. Raises NoPose when the query's features are all zero or not finite."""
        score = global_cosine(query.crop.maps[self.layer], bank.features, norm=bank.norms)
        return rank(score, top_k=self.top_k)
