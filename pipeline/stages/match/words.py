"""query features, visual words of the object -> the templates with the most similar bag of words."""

from __future__ import annotations

from typing import ClassVar, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.errors import NoPose
from pipeline.fits import Fitted, fitted_to, foreground_cells
from pipeline.fits.projection import Projection
from pipeline.fits.vocabulary import Vocabulary
from pipeline.functional.masks import cell_mask
from pipeline.functional.pca import project_onto_axes
from pipeline.items.matches import TemplateMatch
from pipeline.spec import NonNegative, Positive, PositiveFloat, Spec, spec
from pipeline.stages.match import ranked


@spec
class Words(Spec):
    """Cosine similarity of tf-idf vectors of visual words (Örnek et al., "FoundPose", ECCV 2024, section 3.3).

    Where on the object a cell lies plays no part: what hides a part of it removes words and moves none. The fields but
    ``top_k`` are those of the fits (stages/fit): ``dim`` of the projection, which fuse=template_pca of equal layer and
    dim shares; the others of the vocabulary.
    """

    kind: ClassVar[str] = "match.words"
    version: ClassVar[int] = 1

    layer: NonNegative = 11
    top_k: Positive = 5
    dim: Positive = 256
    count: Positive = 2048
    assignments: Positive = 3
    weights: Literal["equal", "gaussian"] = "equal"
    sigma_squared: PositiveFloat = 10.0
    samples: Positive = 100_000
    iterations: Positive = 50
    seed: NonNegative = 0

    @property
    def fit(self) -> Vocabulary:
        """Words, and the templates' vectors."""
        return Vocabulary(
            projection=Projection(layer=self.layer, dim=self.dim),
            count=self.count,
            assignments=self.assignments,
            weights=self.weights,
            sigma_squared=self.sigma_squared,
            samples=self.samples,
            iterations=self.iterations,
            seed=self.seed,
        )

    def __call__(
        self,
        query: Float[Tensor, "c h w"],
        query_mask: Bool[Tensor, "S S"],
        bank: Float[Tensor, "n c h w"],
        bank_mask: Bool[Tensor, "n S S"],
    ) -> TemplateMatch:
        """As ``by_fitted``, fitted here and now to the bank."""
        arrays = fitted_to(self.fit, foreground_cells(bank, bank_mask))
        return self.by_fitted(query, query_mask, {name: array.to(query.device) for name, array in arrays.items()})

    def by_fitted(
        self, query: Float[Tensor, "c h w"], query_mask: Bool[Tensor, "S S"], fitted: Fitted
    ) -> TemplateMatch:
        """The ``top_k`` best templates.

        Raises NoPose for an empty mask, and for features that are not finite or have no telling word in common.
        """
        inside = cell_mask(query_mask, cells=query.shape[-1])
        if not inside.any():
            raise NoPose("match", "query mask is empty, needs 1 pixel")
        points = project_onto_axes(query.float().movedim(0, -1)[inside], fitted["mean"], fitted["axes"])
        if not bool(torch.isfinite(points).all()):
            raise NoPose("match", "features are not finite")
        return ranked(fitted["templates"] @ self.fit.vector(points, fitted), top_k=self.top_k)
