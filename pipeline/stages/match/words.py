"""query features, visual words of the object -> the templates with the most similar bag of words."""

from __future__ import annotations

from typing import ClassVar, Literal

import torch

from pipeline.errors import NoPose
from pipeline.fits.projection import Projection
from pipeline.fits.vocabulary import Vocabulary
from pipeline.functional.masks import cell_mask
from pipeline.functional.pca import project_onto_axes
from pipeline.items.matches import TemplateMatch
from pipeline.items.online import Query, TemplateBank
from pipeline.spec import NonNegative, Positive, PositiveFloat, spec
from pipeline.stages.match import Matcher, rank


@spec
class Words(Matcher):
    """Cosine similarity of tf-idf vectors of visual words (Örnek et al., "FoundPose", ECCV 2024, section 3.3).

    The position of a cell on the object is not used, so an occluder removes words but moves none. All fields except
    ``top_k`` belong to the fits (pipeline.fits): ``dim`` to the projection, which is shared with a fuse=template_pca of
    the same layer and dim, the others to the vocabulary.
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
        """The vocabulary, and each template's tf-idf vector."""
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

    def __call__(self, query: Query, bank: TemplateBank) -> TemplateMatch:
        """The ``top_k`` best templates.

        Raises NoPose for an empty mask, for features that are not finite, and where no word tells templates apart.
        """
        features, fitted = query.crop.maps[self.layer], bank.fitted(self.fit)
        inside = cell_mask(query.crop.mask, cells=features.shape[-1])
        if not inside.any():
            raise NoPose("match", "query mask is empty, needs 1 pixel")
        points = project_onto_axes(features.float().movedim(0, -1)[inside], fitted["mean"], fitted["axes"])
        if not bool(torch.isfinite(points).all()):
            raise NoPose("match", "features are not finite")
        return rank(fitted["templates"] @ self.fit.vector(points, fitted), top_k=self.top_k)
