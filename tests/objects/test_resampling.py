"""Every n-th pixel of an image."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from v3d_torch.objects.resampling import subsample


@given(step=st.integers(1, 5), height=st.integers(1, 12), width=st.integers(1, 12))
def test_subsample_equals_slicing(step: int, height: int, width: int) -> None:
    for images in (torch.rand(2, height, width), torch.rand(height, width) < 0.5):
        found = subsample(images, step)
        assert torch.equal(found, images[..., ::step, ::step]) and found.is_contiguous()
