"""Parts of an image that contain a mask."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from v3d_torch.objects.crops import crop_around


@given(seed=st.integers(0, 2**16), margin=st.integers(0, 6), step=st.integers(1, 5))
def test_crop_contains_all_pixels_within_the_margin_and_no_more_than_the_step_requires(
    seed: int, margin: int, step: int
) -> None:
    rng = np.random.default_rng(seed)
    mask = (rng.random((20, 24)) < 0.01).astype(np.uint8)
    crop = crop_around(mask, margin, step)
    if crop is None:
        assert not mask.any()
        return
    for part, pixels, size in zip(crop, mask.nonzero(), mask.shape, strict=True):
        first, last = max(pixels.min() - margin, 0), pixels.max() + margin
        assert part.start % step == part.stop % step == 0
        assert first - step < part.start <= first and last < part.stop <= last + step
        assert 0 <= part.start < size
