import numpy as np
import pytest
import torch
from sklearn.decomposition import PCA

from pipeline.functional.pca import principal_axes, principal_axes_in_blocks, project_onto_axes


def _samples(m: int, c: int) -> torch.Tensor:
    """Variances that fall by a quarter, so that no two axes are near to one another."""
    generator = torch.Generator().manual_seed(0)
    basis = torch.linalg.qr(torch.randn(c, min(m, c), generator=generator)).Q
    return torch.randn(m, min(m, c), generator=generator) * 0.75 ** torch.arange(min(m, c)) @ basis.T + 5


@pytest.mark.parametrize(("m", "c"), [(20, 300), (300, 20), (64, 64)])
def test_axes_equal_those_of_scikit_learn(m, c):
    samples = _samples(m, c)
    mean, axes = principal_axes(samples, dim=8)
    reference = PCA(n_components=8, svd_solver="full").fit(samples.double().numpy())
    assert np.allclose(mean.numpy(), reference.mean_, atol=1e-5)  # float32 means of values about 5
    cosine = np.abs(np.sum(axes.numpy() * reference.components_.T, axis=0))
    assert (cosine > 1 - 1e-6).all()  # axis 8 has (0.75^7)^2 = 2 % of the first variance; float32 Gram matrix


def test_axes_do_not_depend_on_the_order_or_number_of_repeats_of_samples():
    samples = _samples(40, 30)
    _, axes = principal_axes(samples, dim=4)
    _, shuffled = principal_axes(samples.flip(0).repeat(3, 1), dim=4)
    assert torch.allclose(axes, shuffled, atol=1e-4)  # float32 Gram matrices summed in another order


def test_signs_are_fixed_and_results_are_identical():
    samples = _samples(50, 200)
    _, axes = principal_axes(samples, dim=6)
    assert (axes.gather(0, axes.abs().argmax(0, keepdim=True)) > 0).all()
    assert torch.equal(axes, principal_axes(samples.clone(), dim=6)[1])


@pytest.mark.parametrize(("m", "c"), [(3, 10), (10, 3)])
def test_dimensions_are_clamped_to_what_the_samples_span(m, c):
    _, axes = principal_axes(torch.randn(m, c, generator=torch.Generator().manual_seed(0)), dim=8)
    assert axes.shape[1] == min(m - 1, c)
    assert torch.allclose(axes.T @ axes, torch.eye(axes.shape[1]), atol=1e-5)  # float32


def test_equal_samples_span_no_axis():
    assert principal_axes(torch.ones(5, 7), dim=3)[1].shape == (7, 0)
    assert principal_axes(torch.ones(1, 7), dim=3)[1].shape == (7, 0)


@pytest.mark.parametrize(("m", "c"), [(20, 300), (300, 20)])
def test_axes_in_blocks_equal_scikit_learns_for_any_block_size(m, c):
    samples = _samples(m, c).half()
    reference = PCA(n_components=8, svd_solver="full").fit(samples.double().numpy())
    for block in (7, 1000):
        mean, axes = principal_axes_in_blocks(samples, dim=8, block=block)
        assert mean.dtype == axes.dtype == torch.float32
        assert np.allclose(mean.numpy(), reference.mean_, atol=1e-6)
        assert (np.abs(np.sum(axes.numpy() * reference.components_.T, axis=0)) > 1 - 1e-6).all()
        expected = reference.transform(samples.double().numpy())
        found = project_onto_axes(samples, mean, axes, block=block).numpy()
        assert np.allclose(found, np.sign((found * expected).sum(0)) * expected, atol=1e-4)  # float32 of values about 5
