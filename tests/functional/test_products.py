import pytest
import torch

from pipeline.functional.products import row_products


@pytest.mark.parametrize("shape", [(3, 4, 5), (700, 650, 160), (5000, 4, 4000)])
def test_products_of_rows_are_those_of_float64(shape):
    m, n, c = shape
    a, b = (torch.randn(k, c, generator=torch.Generator().manual_seed(k)) for k in (m, n))
    found = row_products(a, b.T.contiguous().T)  # rows need not be contiguous
    torch.testing.assert_close(found.double(), a.double() @ b.double().T, rtol=1e-4, atol=1e-3)
