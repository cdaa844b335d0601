"""query features, template bank -> the most similar templates."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.errors import BadInput, NoPose
from pipeline.items.fit import Fit
from pipeline.items.matches import TemplateMatch
from pipeline.items.online import Query, TemplateBank
from pipeline.spec import Spec


class Matcher(Spec, ABC):
    """Contract of a match variant.

    ``layer``: the layer that it compares. ``needs_truth``: True for oracles, whose query carries ``truth``.
    """

    layer: int
    needs_truth: ClassVar[bool] = False

    @property
    def layers(self) -> tuple[int, ...]:
        """All layers that it compares: ``layer``, unless a variant overrides this. ``bank.maps`` reads the others."""
        return (self.layer,)

    @property
    def fit(self) -> Fit | None:
        """A model fitted to the templates offline, such as visual words. A matcher with a fit reads
        ``bank.fitted(fit)`` instead of ``bank.features``.
        """
        return None

    @abstractmethod
    def __call__(self, query: Query, bank: TemplateBank) -> TemplateMatch:
        """The best templates of one query; a higher score is better. Raises NoPose when nothing can be compared."""


def rank(score: Float[Tensor, " n"], *, top_k: int) -> TemplateMatch:
    """The ``top_k`` highest of all templates' scores, ties by index. A higher score is better.

    Raises BadInput for scores of another shape, and NoPose when scores are not finite or all are 0.
    """
    if score.ndim != 1:
        raise BadInput("match", found=f"scores of shape {tuple(score.shape)}", needed="(n,): one score per template")
    if not bool(torch.isfinite(score).all()):
        raise NoPose("match", "features are not finite")
    if not bool(score.any()):
        raise NoPose("match", "query and templates share no feature: every similarity is 0")
    best, index = torch.sort(score, descending=True, stable=True)
    margin = float(best[0] - best[top_k]) if len(best) > top_k else 0.0
    return TemplateMatch(index[:top_k], best[:top_k], margin)
