"""query features, template bank -> the templates that look most alike."""

from __future__ import annotations

from typing import ClassVar, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.errors import NoPose
from pipeline.fits import Fit, Fitted
from pipeline.items.matches import TemplateMatch
from pipeline.spec import Variant


class Matcher(Variant, Protocol):
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


@runtime_checkable
class TruthMatcher(Protocol):
    """An oracle that ranks templates by the true pose; no other matcher is shown it."""

    needs_truth: ClassVar[bool]

    def by_truth(
        self,
        T_true: Float[np.ndarray, "4 4"],
        symmetries: Float[np.ndarray, "s 4 4"],
        T_cam_obj: Float[np.ndarray, "n 4 4"],
    ) -> TemplateMatch:
        """The templates nearest to the true view."""
        ...


@runtime_checkable
class FittedMatcher(Protocol):
    """A matcher that stands on something fitted to the object's templates, and needs their features no more."""

    @property
    def fit(self) -> Fit:
        """What it stands on."""
        ...

    def by_fitted(
        self, query: Float[Tensor, "c h w"], query_mask: Bool[Tensor, "S S"], fitted: Fitted
    ) -> TemplateMatch:
        """The best templates of one query. Raises NoPose when nothing can be compared."""
        ...


def ranked(score: Float[Tensor, " n"], *, top_k: int) -> TemplateMatch:
    """The ``top_k`` best of all templates' scores; of equals the one with the lower index.

    Raises NoPose when scores are not finite or none differs from 0.
    """
    if not bool(torch.isfinite(score).all()):
        raise NoPose("match", "features are not finite")
    if not bool(score.any()):
        raise NoPose("match", "query and templates share no feature: every similarity is 0")
    best, index = torch.sort(score, descending=True, stable=True)
    margin = float(best[0] - best[top_k]) if len(best) > top_k else 0.0
    return TemplateMatch(index[:top_k], best[:top_k], margin)
