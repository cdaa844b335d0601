"""query features, template bank -> the templates that look most similar where both show the object."""

from __future__ import annotations

from typing import ClassVar, Literal

from pipeline.errors import NoPose
from pipeline.functional.masks import cell_mask
from pipeline.functional.similarity import cell_cosine, masked_mean
from pipeline.items.matches import TemplateMatch
from pipeline.items.online import Query, TemplateBank
from pipeline.spec import NonNegative, Positive, spec
from pipeline.stages.match import Matcher, rank


@spec
class MaskedCosine(Matcher):
    """Cosine similarity cell by cell, summed over the cells inside both masks.

    ``normalise`` chooses the divisor of the sum. ``intersection`` (cells inside both masks) ignores how well the
    silhouettes agree; ``query`` (the query's cells) penalises a template for each query cell it does not cover;
    ``union`` (cells inside either mask) also for each of its own cells outside the query. On LM-O with HOG, the best
    template was within 15 degrees of the view for 0.47, 0.44 and 0.48 of 283 visible masks.
    """

    kind: ClassVar[str] = "match.masked_cosine"
    version: ClassVar[int] = 1

    layer: NonNegative = 8
    top_k: Positive = 15
    normalise: Literal["intersection", "query", "union"] = "union"

    def __call__(self, query: Query, bank: TemplateBank) -> TemplateMatch:
        """The ``top_k`` best templates. Raises NoPose for an empty mask and for features without content."""
        features = query.crop.maps[self.layer]
        cells = features.shape[-1]
        query_mask, bank_mask = cell_mask(query.crop.mask, cells=cells), bank.cell_mask
        if not query_mask.any():
            raise NoPose("match", "query mask is empty, needs 1 pixel")
        both = query_mask & bank_mask
        divisor = {
            "intersection": both,
            "query": query_mask.expand_as(bank_mask),
            "union": query_mask | bank_mask,
        }[self.normalise]
        similarity = cell_cosine(features, bank.features, norm=bank.cell_norms)
        return rank(masked_mean(similarity, both, count=divisor.sum((1, 2)).float()), top_k=self.top_k)
