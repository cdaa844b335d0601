import numpy as np
import pytest
import torch
from sklearn.feature_extraction.text import TfidfTransformer

from pipeline.functional.similarity import l2_normalize
from pipeline.functional.tfidf import inverse_frequency, nearest_words, soft_weights, word_counts

DOCUMENTS, WORDS = 7, 12


def _bag(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Points of seven documents, the document of each point, and words."""
    generator = torch.Generator().manual_seed(seed)
    points, words = torch.randn(90, 5, generator=generator), torch.randn(WORDS, 5, generator=generator)
    return points, torch.arange(90) % DOCUMENTS, words


def test_nearest_words_equal_a_loop():
    points, _, words = _bag()
    squared, index = nearest_words(points, words, count=3)
    for point, distances, nearest in zip(points.double(), squared.tolist(), index.tolist(), strict=True):
        all_squared = ((words.double() - point) ** 2).sum(1)
        expected = all_squared.argsort()[:3]
        assert nearest == expected.tolist()
        assert distances == pytest.approx(all_squared[expected].tolist(), abs=1e-5)  # float32
    assert nearest_words(points, words[:2], count=3)[1].shape == (90, 2)


def test_weights_of_a_point_have_length_one_and_fall_with_the_distance():
    squared = torch.tensor([[0.0, 2.0, 8.0], [5e4, 5e4 + 2.0, 5e4 + 8]])
    equal, gaussian = soft_weights(squared, sigma_squared=None), soft_weights(squared, sigma_squared=2.0)
    assert torch.allclose(equal, torch.full((2, 3), 3**-0.5))
    expected = np.exp(-np.array([0.0, 2.0, 8.0]) / 4)
    assert np.allclose(gaussian, expected / np.linalg.norm(expected), atol=1e-6)  # also far from all words


def test_tfidf_equals_scikit_learns_without_the_1_added_to_idf():
    """norm="l2", use_idf=True, smooth_idf=False, sublinear_tf=False; its idf is ln(n / df) + 1, ours ln(n / df)."""
    points, document, words = _bag()
    squared, index = nearest_words(points, words, count=1)
    counts = word_counts(index, torch.ones_like(squared), document, documents=DOCUMENTS, words=WORDS)
    assert counts.sum() == 90
    reference = TfidfTransformer(norm="l2", use_idf=True, smooth_idf=False, sublinear_tf=False).fit(counts.numpy())
    idf = inverse_frequency(index[:, 0], document, documents=DOCUMENTS, words=WORDS)
    used = counts.sum(0) > 0
    assert np.allclose(idf[used], reference.idf_[used] - 1, atol=1e-6)
    assert torch.allclose(idf[~used], torch.tensor(DOCUMENTS).float().log())

    squared, index = nearest_words(points, words, count=3)
    soft = word_counts(index, soft_weights(squared, sigma_squared=4.0), document, documents=DOCUMENTS, words=WORDS)
    reference.idf_ = idf.numpy()
    assert np.allclose(l2_normalize(soft * idf), reference.transform(soft.numpy()).toarray(), atol=1e-6)


def test_word_in_every_document_has_weight_0():
    nearest, document = torch.tensor([0, 0, 1]), torch.tensor([0, 1, 1])
    assert inverse_frequency(nearest, document, documents=2, words=3).tolist() == pytest.approx(
        [0, np.log(2), np.log(2)]
    )
