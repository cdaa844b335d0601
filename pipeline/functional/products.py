"""Matrix products by the fastest library at hand."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

_SMALL = 1 << 26  # multiplications; oneDNN spends half a millisecond on a new shape


def row_products(a: Float[Tensor, "m c"], b: Float[Tensor, "n c"], *, repeats: int = 1) -> Float[Tensor, "m n"]:
    """Dot product of every row of a with every row of b.

    On CPUs, torch multiplies matrices with MKL, which does not use the widest instructions of AMD's processors. oneDNN
    does, and takes half the time; torch offers its products in float32 as a convolution of one cell. ``repeats``:
    how many products of this shape will be computed.
    """
    (m, c), n = a.shape, len(b)
    if (
        a.is_cuda
        or a.dtype != torch.float32
        or m * n * c * repeats < _SMALL
        or not torch.backends.mkldnn.is_available()
    ):
        return a @ b.T
    image = a.contiguous().view(1, m, 1, c).permute(0, 3, 1, 2)  # channels last, as oneDNN reads it
    filters = b.contiguous().view(n, c, 1, 1)
    found = torch.mkldnn_convolution(image, filters, None, (0, 0), (1, 1), (1, 1), 1)
    return found.permute(0, 2, 3, 1).reshape(m, n)
