"""query features, template bank -> the templates that look most alike where both see the object."""

from __future__ import annotations

from typing import ClassVar, Literal

from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.errors import NoPose
from pipeline.functional.masks import cell_mask
from pipeline.functional.similarity import cell_cosine, masked_mean
from pipeline.items.matches import TemplateMatch
from pipeline.spec import NonNegative, Positive, Spec, spec
from pipeline.stages.match import ranked


@spec
class MaskedCosine(Spec):
    """Cosine similarity cell by cell, summed over the cells inside both masks.

    ``normalise``: what the sum is divided by. ``intersection``, the cells inside both masks, ignores how well the
    silhouettes agree; ``query``, the query's cells, makes a template pay for each cell of the query it does not cover;
    ``union``, the cells inside either mask, also for each of its own that the query lacks. On LM-O with HOG, the best
    template was within 15 degrees of the view for 0.47, 0.44 and 0.48 of 283 visible masks.
    """

    kind: ClassVar[str] = "match.masked_cosine"
    version: ClassVar[int] = 1

    layer: NonNegative = 8
    top_k: Positive = 15
    normalise: Literal["intersection", "query", "union"] = "union"

    def __call__(
        self,
        query: Float[Tensor, "c h w"],
        query_mask: Bool[Tensor, "S S"],
        bank: Float[Tensor, "n c h w"],
        bank_mask: Bool[Tensor, "n S S"],
    ) -> TemplateMatch:
        """The ``top_k`` best templates. Raises NoPose for an empty mask and for features without content."""
        cells = query.shape[-1]
        of_query, of_bank = cell_mask(query_mask, cells=cells), cell_mask(bank_mask, cells=cells)
        if not of_query.any():
            raise NoPose("match", "query mask is empty, needs 1 pixel")
        over = {
            "intersection": of_query & of_bank,
            "query": of_query.expand_as(of_bank),
            "union": of_query | of_bank,
        }[self.normalise]
        similarity = cell_cosine(query, bank)
        return ranked(masked_mean(similarity, of_query & of_bank, count=over.sum((1, 2)).float()), top_k=self.top_k)
