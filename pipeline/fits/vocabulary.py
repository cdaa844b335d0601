"""template features, their projection -> visual words of an object, and each template's tf-idf vector."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.fits.projection import Projection
from pipeline.functional.kmeans import kmeans
from pipeline.functional.pca import project_onto_axes
from pipeline.functional.similarity import l2_normalize
from pipeline.functional.tfidf import inverse_frequency, nearest_words, soft_weights, word_counts
from pipeline.items.features import FittedArrays, TemplateCells
from pipeline.items.fit import Fit
from pipeline.spec import NonNegative, Positive, PositiveFloat, Spec, spec


@spec
class Vocabulary(Spec):
    """Visual words: k-means centres of projected descriptors (Örnek et al., "FoundPose", ECCV 2024, section 3.3).

    Each descriptor is assigned to its ``assignments`` nearest words, with equal or ``gaussian`` weights (variance
    ``sigma_squared``). The centres are fitted to at most ``samples`` descriptors, drawn with ``seed``; words are
    counted over all of them. Departure from the released code: a word that no descriptor is nearest to has idf ln(n),
    not infinity.
    """

    kind: ClassVar[str] = "fit.vocabulary"
    version: ClassVar[int] = 1

    projection: Projection
    count: Positive
    assignments: Positive
    weights: Literal["equal", "gaussian"]
    sigma_squared: PositiveFloat
    samples: Positive
    iterations: Positive
    seed: NonNegative

    @property
    def layer(self) -> int:
        """The projection's layer."""
        return self.projection.layer

    @property
    def base(self) -> Fit | None:
        """The projection."""
        return self.projection

    def array_bytes(self, channels: int, templates: int) -> int:
        """Bytes of the words, their idf and the templates' vectors."""
        return 4 * self.count * (min(self.projection.dim, channels) + 1 + templates)

    def __call__(self, cells: TemplateCells, base: FittedArrays) -> dict[str, Tensor]:
        """``words`` (w d), ``idf`` (w) and unit tf-idf vectors ``templates`` (n w), with w at most ``count``."""
        points = project_onto_axes(cells.features.cpu(), base["mean"], base["axes"])
        document = cells.template.cpu()
        _, words = kmeans(self._sample(points), count=self.count, seed=self.seed, iterations=self.iterations)
        squared, index = nearest_words(points, words, count=self.assignments)
        idf = inverse_frequency(index[:, 0], document, documents=cells.templates, words=len(words))
        return {"words": words, "idf": idf, "templates": self._vectors(squared, index, document, cells.templates, idf)}

    def vector(self, points: Float[Tensor, "m d"], fitted: FittedArrays) -> Float[Tensor, " w"]:
        """Unit tf-idf vector of one view's projected descriptors; zero where no word distinguishes templates."""
        squared, index = nearest_words(points, fitted["words"], count=self.assignments)
        document = torch.zeros(len(points), dtype=torch.int64, device=points.device)
        return self._vectors(squared, index, document, 1, fitted["idf"])[0]

    def _vectors(
        self,
        squared: Float[Tensor, "m k"],
        index: Int[Tensor, "m k"],
        document: Int[Tensor, " m"],
        documents: int,
        idf: Float[Tensor, " w"],
    ) -> Float[Tensor, "n w"]:
        weight = soft_weights(squared, sigma_squared=self.sigma_squared if self.weights == "gaussian" else None)
        return l2_normalize(word_counts(index, weight, document, documents=documents, words=len(idf)) * idf)

    def _sample(self, points: Float[Tensor, "m d"]) -> Float[Tensor, "s d"]:
        if len(points) <= self.samples:
            return points
        drawn = np.random.default_rng(self.seed).choice(len(points), self.samples, replace=False)
        return points[torch.from_numpy(np.sort(drawn))]
