"""Principal component analysis by the eigenvectors of the smaller Gram matrix: exact, and the same every time."""

from __future__ import annotations

import numpy as np
import scipy.linalg
import torch
from jaxtyping import Float
from torch import Tensor

_NEGLIGIBLE = 1e-5  # of the largest variance: below it, a float32 Gram matrix of float16 features holds rounding


def principal_axes(samples: Float[Tensor, "m c"], *, dim: int) -> tuple[Float[Tensor, " c"], Float[Tensor, "c k"]]:
    """Mean, and the k <= ``dim`` orthonormal directions of largest variance, largest first.

    k is smaller where the samples span fewer dimensions. Of each axis the component of largest magnitude is positive.
    Only the leading eigenvectors are computed (LAPACK syevr, on the CPU for every device). Raises ValueError for
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
    """As ``principal_axes``, of more samples than fit in float32: float16 is read block by block, sums are float64.

    Results are float32. Raises ValueError for samples that are not finite.
    """
    blocks = samples.split(block)
    mean = torch.stack([part.double().sum(0) for part in blocks]).sum(0) / len(samples)
    gram = torch.zeros(len(mean), len(mean), dtype=torch.float64, device=samples.device)
    for part in blocks:
        centred = part.double() - mean
        gram += centred.T @ centred
    _, vectors = _leading_eigenvectors(gram.cpu().numpy(), dim)
    axes = torch.from_numpy(vectors).to(samples.device, torch.float32)
    return mean.float(), _fix_signs(axes)


def project_onto_axes(
    samples: Float[Tensor, "m c"], mean: Float[Tensor, " c"], axes: Float[Tensor, "c k"], *, block: int = 1 << 13
) -> Float[Tensor, "m k"]:
    """Coordinates of samples, less the mean, on the axes, in float32."""
    shift = mean @ axes
    return torch.cat([part.float() @ axes - shift for part in samples.split(block)])


def _gram_matrix(x: Float[Tensor, "a b"], *, exact: bool) -> np.ndarray:
    """Products of all pairs of rows: numpy knows x x^T for what it is, and computes half of it.

    ``exact``, float64: for few samples, whose axes are sums of them over the root of their variance. Otherwise in the
    samples' own precision, which is as well that of the eigenvectors.
    """
    if x.device.type != "cpu":
        gram = (x @ x.T).cpu().numpy()
        return gram.astype(np.float64) if exact else gram
    a = (x.double() if exact else x).numpy()
    return a @ a.T


def _leading_eigenvectors(gram: np.ndarray, dim: int) -> tuple[np.ndarray, np.ndarray]:
    size = len(gram)
    values, vectors = scipy.linalg.eigh(gram, subset_by_index=[max(0, size - dim), size - 1], driver="evr")
    values, vectors = values[::-1].copy(), vectors[:, ::-1].copy()
    keep = values > max(_NEGLIGIBLE * values[0], np.finfo(np.float32).tiny)
    return values[keep], vectors[:, keep]


def _fix_signs(axes: Float[Tensor, "c k"]) -> Float[Tensor, "c k"]:
    if axes.shape[1] == 0:
        return axes
    largest = axes.gather(0, axes.abs().argmax(0, keepdim=True))
    return axes * torch.where(largest < 0, -1.0, 1.0)
