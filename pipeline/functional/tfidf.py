"""Bags of visual words with tf-idf weights (Sivic and Zisserman, "Video Google", ICCV 2003) and soft assignment.

The weighting equals scikit-learn's ``TfidfTransformer(norm="l2", smooth_idf=False, sublinear_tf=False)`` without the 1
that it adds to every idf: a word present in all templates has weight 0.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.functional.similarity import l2_normalize
from pipeline.parallel import ordered_map

_BLOCK = 1 << 13  # descriptors compared with all words at a time


def nearest_words(
    points: Float[Tensor, "m d"], words: Float[Tensor, "w d"], *, count: int
) -> tuple[Float[Tensor, "m k"], Int[Tensor, "m k"]]:
    """Squared Euclidean distances to, and indices of, each point's k <= ``count`` nearest words, nearest first."""
    count, lengths = min(count, len(words)), (words * words).sum(1)

    def nearest(block: Tensor) -> tuple[Tensor, Tensor]:
        squared, index = torch.topk(torch.addmm(lengths, block, words.T, alpha=-2), count, largest=False)
        return squared, index

    blocks = list(ordered_map(nearest, points.split(_BLOCK)))
    index = torch.cat([index for _, index in blocks])
    squared = torch.cat([squared for squared, _ in blocks]) + (points * points).sum(1, keepdim=True)
    return squared.clamp(min=0), index


def soft_weights(squared: Float[Tensor, "m k"], *, sigma_squared: float | None) -> Float[Tensor, "m k"]:
    """Weights of each point's words: exp(-d^2 / (2 sigma^2)), or equal without ``sigma_squared``; rows of length 1.

    Philbin et al., "Lost in Quantization", CVPR 2008, section 4; normalised to length 1, not sum 1, as in FoundPose's
    code.
    """
    if sigma_squared is None:
        return l2_normalize(torch.ones_like(squared))
    nearest = squared.min(1, keepdim=True).values  # avoids underflow; normalisation cancels the shift
    return l2_normalize(torch.exp((nearest - squared) / (2 * sigma_squared)))


def word_counts(
    index: Int[Tensor, "m k"], weight: Float[Tensor, "m k"], document: Int[Tensor, " m"], *, documents: int, words: int
) -> Float[Tensor, "n w"]:
    """Term frequencies: sum of the weights that each document's points give each word.

    Not divided by the number of points, since cosines ignore scale.
    """
    total = torch.zeros(documents * words, dtype=weight.dtype, device=weight.device)
    total.index_add_(0, (document[:, None] * words + index).flatten(), weight.flatten())
    return total.view(documents, words)


def inverse_frequency(
    nearest: Int[Tensor, " m"], document: Int[Tensor, " m"], *, documents: int, words: int
) -> Float[Tensor, " w"]:
    """Inverse document frequency ln(n / n_w), n_w the number of documents (at least 1) with a point nearest to w."""
    present = torch.zeros(documents, words, dtype=torch.bool, device=nearest.device)
    present[document, nearest] = True
    return torch.log(documents / present.sum(0).clamp(min=1).float())
