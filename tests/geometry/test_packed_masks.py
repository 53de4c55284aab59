"""Masks with one bit per pixel."""

from __future__ import annotations

import pytest
import torch

from v3d_torch.geometry.packed_masks import count_common_pixels, count_pixels, pack_masks, unpack_mask


@pytest.mark.parametrize("size", [(1, 1), (3, 5), (8, 8), (120, 160), (67, 120)])
@pytest.mark.parametrize("counts", [(0, 3), (1, 1), (7, 4)])
def test_counts_equal_those_of_the_masks(size: tuple[int, int], counts: tuple[int, int]) -> None:
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.rand(count, *size, generator=generator) < 0.4 for count in counts)
    expected = a.flatten(1).double() @ b.flatten(1).double().T
    assert torch.equal(count_common_pixels(pack_masks(a), pack_masks(b)), expected.long())
    assert torch.equal(count_pixels(pack_masks(a)), a.flatten(1).sum(dim=1))


def test_one_mask_is_packed_alone() -> None:
    mask = torch.tensor([[True, False, True]])
    assert pack_masks(mask).shape == (8,)
    assert count_pixels(pack_masks(mask)) == 2


def test_every_nth_row_and_column_is_packed() -> None:
    masks = torch.rand(3, 21, 34, generator=torch.Generator().manual_seed(0)) < 0.5
    assert torch.equal(pack_masks(masks, 4), pack_masks(masks[:, ::4, ::4]))


@pytest.mark.parametrize("size", [(1, 1), (3, 5), (120, 160), (67, 121), (0, 4)])
def test_unpacked_mask_is_the_mask(size: tuple[int, int]) -> None:
    mask = torch.rand(size, generator=torch.Generator().manual_seed(0)) < 0.4
    unpacked = unpack_mask(pack_masks(mask), size)
    assert unpacked.dtype == torch.bool and torch.equal(unpacked, mask)
