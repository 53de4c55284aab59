"""Products of matrices with many rows."""

from __future__ import annotations

import pytest
import torch
from helpers.library_settings import torch_threads

from v3d_torch.geometry.long_products import sum_products


@pytest.mark.parametrize("batch", [(), (2,)])
@pytest.mark.parametrize("rows", [0, 1, 255, 256, 257, 50_000])
def test_product_equals_the_matrix_product_and_does_not_depend_on_threads(batch: tuple[int, ...], rows: int) -> None:
    generator = torch.Generator().manual_seed(rows)
    a, b = (torch.rand(*batch, rows, width, dtype=torch.float64, generator=generator) for width in (8, 3))
    product = sum_products(a, b)
    torch.testing.assert_close(product, a.mT @ b, rtol=1e-12, atol=0)
    with torch_threads(2):
        assert torch.equal(sum_products(a, b), product)
