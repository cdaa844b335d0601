"""Principal component analysis by eigenvectors of the smaller Gram matrix: exact and deterministic."""

from __future__ import annotations

import numpy as np
import scipy.linalg
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.parallel import ordered_map

_NEGLIGIBLE = 1e-5  # of the largest variance: smaller ones are rounding errors in a float32 Gram matrix


def principal_axes(samples: Float[Tensor, "m c"], *, dim: int) -> tuple[Float[Tensor, " c"], Float[Tensor, "c k"]]:
    """Mean, and the k <= ``dim`` orthonormal axes of largest variance, in descending order.

    k < ``dim`` if the samples span fewer dimensions. Signs are fixed: the component of largest magnitude of each axis
    is positive. Only the leading eigenvectors are computed (LAPACK syevr, always on the CPU). Raises ValueError for
    samples that are not finite.
    """
    mean = samples.mean(0)
    centred = samples - mean
    wide = centred.shape[0] < centred.shape[1]
    variance, vectors = _leading_eigenvectors(_gram_matrix(centred if wide else centred.T, exact=wide), dim)
    leading = torch.from_numpy(vectors).to(samples.device, samples.dtype)
    if wide:
        leading = centred.T @ (leading / torch.from_numpy(variance).sqrt().to(leading))
    return mean, _fix_signs(leading)


def principal_axes_in_blocks(
    samples: Float[Tensor, "m c"], *, dim: int, block: int = 1 << 13
) -> tuple[Float[Tensor, " c"], Float[Tensor, "c k"]]:
    """As ``principal_axes``, for samples too large to copy to float32: blocks are summed in float64.

    Results are float32. Raises ValueError for samples that are not finite.
    """
    blocks = samples.split(block)
    mean = torch.stack([part.double().sum(0) for part in blocks]).sum(0) / len(samples)
    gram = torch.zeros(len(mean), len(mean), dtype=torch.float64, device=samples.device)

    def product(part: Tensor) -> Tensor:
        centred = part.double() - mean
        return centred.T @ centred

    for part in ordered_map(product, blocks):
        gram += part
    _, vectors = _leading_eigenvectors(gram.cpu().numpy(), dim)
    axes = torch.from_numpy(vectors).to(samples.device, torch.float32)
    return mean.float(), _fix_signs(axes)


def project_onto_axes(
    samples: Float[Tensor, "m c"], mean: Float[Tensor, " c"], axes: Float[Tensor, "c k"], *, block: int = 1 << 13
) -> Float[Tensor, "m k"]:
    """Coordinates of the samples, minus the mean, along the axes; float32."""
    shift = mean @ axes
    return torch.cat(list(ordered_map(lambda part: part.float() @ axes - shift, samples.split(block))))


def _gram_matrix(x: Float[Tensor, "a b"], *, exact: bool) -> np.ndarray:
    """Gram matrix x x^T. On the CPU by numpy, which computes only half of the symmetric product.

    ``exact``: in float64, needed when the axes are formed from the samples divided by the root of their variance.
    Otherwise in the samples' precision.
    """
    if x.device.type != "cpu":
        gram = (x @ x.T).cpu().numpy()
        return gram.astype(np.float64) if exact else gram
    a = (x.double() if exact else x).numpy()
    return a @ a.T


def _leading_eigenvectors(gram: np.ndarray, dim: int) -> tuple[np.ndarray, np.ndarray]:
    """At most ``dim`` eigenvalues, largest first and without negligible ones, and their eigenvectors as columns."""
    size = len(gram)
    values, vectors = scipy.linalg.eigh(gram, subset_by_index=[max(0, size - dim), size - 1], driver="evr")
    values, vectors = values[::-1].copy(), vectors[:, ::-1].copy()
    keep = values > max(_NEGLIGIBLE * values[0], np.finfo(np.float32).tiny)
    return values[keep], vectors[:, keep]


def _fix_signs(axes: Float[Tensor, "c k"]) -> Float[Tensor, "c k"]:
    """Axes flipped so that the component of largest magnitude is positive."""
    if axes.shape[1] == 0:
        return axes
    largest = axes.gather(0, axes.abs().argmax(0, keepdim=True))
    return axes * torch.where(largest < 0, -1.0, 1.0)
