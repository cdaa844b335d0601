"""Matches of templates, and of points of a template with points of the query."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True, eq=False)
class TemplateMatch:
    """The k best templates, best first. ``margin``: best score minus the best score outside these k (0 if none)."""

    index: Int[Tensor, " k"]
    score: Float[Tensor, " k"]
    margin: float


@dataclass(frozen=True, eq=False)
class TrueMatches:
    """Where template points truly appear in the query, both in crop pixels; input of correspond=oracle."""

    template_px: Float[Tensor, "m 2"]
    query_px: Float[Tensor, "m 2"]
    query_mask: Bool[Tensor, "S S"]


@dataclass(frozen=True, eq=False)
class Correspondences:
    """m corresponding points, crop pixels (x, y), with their cosine similarity and the index of their cluster pair."""

    query_px: Float[Tensor, "m 2"]
    template_px: Float[Tensor, "m 2"]
    similarity: Float[Tensor, " m"]
    cluster: Int[Tensor, " m"]
