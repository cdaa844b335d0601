import numpy as np
import pytest
import torch
from sklearn.decomposition import PCA
from sklearn.feature_extraction.text import TfidfTransformer

from pipeline.errors import DzopError
from pipeline.fits import chain, fit_arrays, foreground_cells
from pipeline.fits.projection import Projection, project_map
from pipeline.functional.masks import cell_mask
from pipeline.items.features import TemplateCells
from pipeline.spec import digest
from pipeline.stages.fuse.template_pca import TemplatePca
from pipeline.stages.match.words import Words


def _bank(n: int = 9) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    mask = torch.zeros(n, 32, 32, dtype=torch.bool)
    for i in range(n):
        mask[i, 4 : 20 + i, 6 : 28 - i] = True
    decay = 0.8 ** torch.arange(24)[:, None, None]
    return (3 + torch.randn(n, 24, 8, 8, generator=generator) * decay).half(), mask


def test_foreground_cells_are_those_of_the_masks_with_their_template():
    bank, mask = _bank()
    cells = foreground_cells(bank, mask)
    assert cells.templates == 9
    assert cells.features.dtype == torch.float16
    inside = cell_mask(mask, cells=8)
    assert torch.bincount(cells.template).tolist() == inside.sum((1, 2)).tolist()
    i, row, column = inside.nonzero()[17].tolist()
    assert torch.equal(cells.features[17], bank[i, :, row, column])


def test_a_projection_is_scikit_learns_pca_of_all_foreground_cells():
    bank, mask = _bank()
    cells = foreground_cells(bank, mask)
    arrays = Projection(layer=11, dim=5)(cells, {})
    reference = PCA(n_components=5, svd_solver="full").fit(cells.features.double().numpy())
    found = project_map(bank[2], arrays).flatten(1).T.numpy()
    expected = reference.transform(bank[2].flatten(1).T.double().numpy())
    assert np.allclose(found, np.sign((found * expected).sum(0)) * expected, atol=1e-4)  # float32 of values about 3


def test_features_that_are_the_same_everywhere_cannot_be_projected():
    cells = TemplateCells(torch.ones(20, 4), torch.zeros(20, dtype=torch.int64), 1)
    with pytest.raises(DzopError, match="features of layer 11 are the same in all 20 template cells"):
        Projection(layer=11, dim=3)(cells, {})


def test_words_are_of_projected_cells_and_template_vectors_scikit_learns_tfidf():
    match = Words(dim=6, count=20, assignments=1)
    bank, mask = _bank()
    cells = foreground_cells(bank, mask)
    arrays = fit_arrays(match.fit, cells)
    assert set(arrays) == {"mean", "axes", "words", "idf", "templates"}
    assert arrays["words"].shape == (20, 6)
    points = (cells.features.float() - arrays["mean"]) @ arrays["axes"]
    word = torch.cdist(points.double(), arrays["words"].double()).argmin(1)
    counts = np.zeros((9, 20))
    np.add.at(counts, (cells.template.numpy(), word.numpy()), 1)
    reference = TfidfTransformer(norm="l2", smooth_idf=False).fit(counts)
    reference.idf_ = reference.idf_ - 1
    assert np.allclose(arrays["templates"], reference.transform(counts).toarray(), atol=1e-6)


def test_fits_are_the_same_bytes_every_time_and_shared_where_their_recipes_are():
    bank, mask = _bank()
    fit = Words(dim=6, count=20, samples=100).fit
    first, again = (fit_arrays(fit, foreground_cells(bank.clone(), mask)) for _ in range(2))
    assert all(torch.equal(first[name], again[name]) for name in first)
    other = fit_arrays(Words(dim=6, count=20, samples=100, seed=1).fit, foreground_cells(bank, mask))
    assert not torch.equal(first["words"], other["words"])
    assert chain(fit) == (TemplatePca(layers=(11,), dim=6).fit, fit)
    assert Words(top_k=1).fit == Words(top_k=9).fit  # a sweep over what is kept fits nothing again


def test_fits_are_those_of_their_version():
    """When this fails on purpose, raise the fit's own version, beside that of the stage: stored fits are kept by it."""
    fit = Words(dim=6, count=20, weights="gaussian").fit
    arrays = fit_arrays(fit, foreground_cells(*_bank()))
    assert (fit.version, fit.projection.version) == (1, 1)
    assert digest(fit.recipe()) == "f5e6bb37a1953ede9dc1ef4cebaf742da33651dac773e78f721fd014997c2314"
    found = [float(arrays[name].abs().double().sum()) for name in ("mean", "axes", "words", "idf", "templates")]
    # float32 sums differ between processors; a change of method moves far more
    assert found == pytest.approx([71.909, 7.92, 50.163, 9.091, 30.547], rel=2e-3)
