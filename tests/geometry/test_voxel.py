"""Voxel pooling against group-by of pandas."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pandas as pd
import pytest
import torch
from helpers.library_settings import torch_threads
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.errors import ConfigError, InputError
from v3d_torch.geometry.voxel import VoxelPool, voxel_pool

DTYPES = [torch.float32, torch.float64]


def random_clouds(batch: int, count: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """Clouds around the origin; about a third of the points are padding, filled with NaN."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(batch, count, 3, generator=generator, dtype=dtype) * 0.1
    valid = torch.rand(batch, count, generator=generator) < 0.7
    points[~valid] = torch.nan
    return points, valid


def pool_by_pandas(points: Tensor, valid: Tensor, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Means and counts of the voxels of one cloud, sorted by voxel."""
    kept = points[valid].numpy()
    cells = pd.DataFrame(np.floor(kept / np.asarray(size, kept.dtype)), columns=["i", "j", "k"])
    groups = pd.DataFrame(kept.astype(np.float64)).groupby([cells.i, cells.j, cells.k])
    return groups.mean().to_numpy().reshape(-1, 3), groups.size().to_numpy()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("count", [1, 7, 3000, 20_000])
def test_pooling_equals_group_by(dtype: torch.dtype, count: int) -> None:
    points, valid = random_clouds(3, count, dtype=dtype)
    voxels = voxel_pool(points, valid, 0.05)
    assert voxels.means.dtype == dtype
    for b in range(3):
        means, counts = pool_by_pandas(points[b], valid[b], 0.05)
        present = voxels.valid[b]
        np.testing.assert_allclose(voxels.means[b][present].numpy(), means, atol=1e-12 if dtype.itemsize == 8 else 1e-6)
        np.testing.assert_array_equal(voxels.counts[b][present].numpy(), counts)
        assert not voxels.means[b][~present].any() and not voxels.counts[b][~present].any()
    assert voxels.means.shape[1] == voxels.valid.sum(dim=1).max()


@pytest.mark.parametrize("with_gradient", [False, True], ids=["kernel", "torch"])
def test_mean_of_many_equal_points_is_the_point(with_gradient: bool) -> None:
    point = torch.tensor([0.1, -0.7, 3.3])
    points = point.repeat(1, 1_000_000, 1).requires_grad_(with_gradient)
    voxels = voxel_pool(points, torch.ones(1, 1_000_000, dtype=torch.bool), 0.05)
    assert voxels.counts.tolist() == [[1_000_000]] and voxels.means.dtype == torch.float32
    assert torch.equal(voxels.means[0, 0], point)


@settings(max_examples=60)
@given(
    cloud=st.lists(st.tuples(*[st.integers(-40, 40)] * 3), max_size=300),
    copies=st.integers(1, 3),
    size=st.sampled_from([0.125, 0.5, 2.0]),
    spread=st.sampled_from([1, 2**7, 2**14]),
)
def test_pooling_of_any_cloud_equals_group_by(
    cloud: list[tuple[int, int, int]], copies: int, size: float, spread: int
) -> None:
    # Multiples of 1/16: duplicates, lines and points on voxel faces are common, and all sums are exact. The voxels of
    # the bounding box need 16, 32 or 64 bits to be numbered.
    points = torch.tensor(cloud * copies, dtype=torch.float64).reshape(1, -1, 3) / 16 * spread
    voxels = voxel_pool(points, torch.ones(points.shape[:2], dtype=torch.bool), size)
    means, counts = pool_by_pandas(points[0], torch.ones(points.shape[1], dtype=torch.bool), size)
    np.testing.assert_allclose(voxels.means[0].numpy(), means, atol=1e-12)
    np.testing.assert_array_equal(voxels.counts[0].numpy(), counts)


def test_convention_grid_starts_at_the_origin() -> None:
    points = torch.tensor([[[0.0, 0.0, 0.0], [0.9, 0.9, 0.9], [-0.1, 0.0, 0.0], [1.0, 0.0, 0.0]]])
    voxels = voxel_pool(points, torch.ones(1, 4, dtype=torch.bool), 1.0)
    expected = torch.tensor([[-0.1, 0.0, 0.0], [0.45, 0.45, 0.45], [1.0, 0.0, 0.0]])
    torch.testing.assert_close(voxels.means[0], expected)


def test_pooling_of_no_points_is_empty() -> None:
    for batch, count in [(0, 5), (2, 0), (2, 5)]:
        voxels = voxel_pool(torch.full((batch, count, 3), torch.nan), torch.zeros(batch, count, dtype=torch.bool), 0.1)
        assert voxels.means.shape == (batch, 0, 3)
        assert voxels.valid.shape == voxels.counts.shape == (batch, 0)
    points, valid = random_clouds(3, 50)
    valid[1] = False
    voxels = voxel_pool(points, valid, 0.05)
    assert not voxels.valid[1].any() and voxels.valid[0].any() and voxels.valid[2].any()


def test_pooling_does_not_depend_on_padding_or_batch() -> None:
    points, valid = random_clouds(3, 200)
    voxels = voxel_pool(points, valid, 0.05)
    for b in range(3):
        alone = voxel_pool(points[b : b + 1, valid[b]], torch.ones(1, int(valid[b].sum()), dtype=torch.bool), 0.05)
        assert torch.equal(alone.means[0], voxels.means[b][voxels.valid[b]])


@pytest.mark.parametrize("dtype", DTYPES)
def test_voxel_index_of_each_point(dtype: torch.dtype) -> None:
    points, valid = random_clouds(3, 4000, dtype=dtype)
    valid[1, 20:] = False  # the voxels of this cloud are mostly padding
    voxels = voxel_pool(points, valid, 0.05)
    assert voxels.voxel_index.shape == valid.shape and voxels.voxel_index.dtype == torch.int64
    assert torch.equal(voxels.voxel_index >= 0, valid) and voxels.voxel_index[~valid].eq(-1).all()
    for b in range(3):
        cells = pd.DataFrame(np.floor(points[b, valid[b]].numpy() / np.asarray(0.05, points.numpy().dtype)))
        np.testing.assert_array_equal(voxels.voxel_index[b, valid[b]].numpy(), cells.groupby([0, 1, 2]).ngroup())


def test_voxel_index_of_padding_is_minus_one() -> None:
    for batch, count in [(0, 5), (2, 0), (2, 5)]:
        voxel_index = voxel_pool(
            torch.zeros(batch, count, 3), torch.zeros(batch, count, dtype=torch.bool), 0.1
        ).voxel_index
        assert torch.equal(voxel_index, torch.full((batch, count), -1))


def test_clouds_of_a_batch_do_not_share_voxels() -> None:
    points = torch.rand(3, 5, 3, generator=torch.Generator().manual_seed(1))
    valid = torch.ones(3, 5, dtype=torch.bool)
    valid[1] = False
    voxels = voxel_pool(points, valid, 1.0)
    assert voxels.counts.tolist() == [[5], [0], [5]]
    torch.testing.assert_close(voxels.means[[0, 2], 0], points[[0, 2]].mean(dim=1))


def test_pooling_does_not_depend_on_the_order_of_points() -> None:
    points, valid = random_clouds(2, 500)
    shuffled = torch.randperm(500, generator=torch.Generator().manual_seed(3))
    one, other = voxel_pool(points, valid, 0.05), voxel_pool(points[:, shuffled], valid[:, shuffled], 0.05)
    torch.testing.assert_close(one.means, other.means)
    assert torch.equal(one.counts, other.counts)


def test_pooling_gradcheck() -> None:
    points, valid = random_clouds(2, 12)
    points[~valid] = 0
    points.requires_grad_()
    assert torch.autograd.gradcheck(lambda p: voxel_pool(p, valid, 0.15).means, (points,))


def test_memory_does_not_grow_with_the_bounding_box() -> None:
    points = 1000 * torch.rand(1, 20_000, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    tracemalloc.start()
    voxels = voxel_pool(points, torch.ones(1, 20_000, dtype=torch.bool), 0.02)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert voxels.valid.all() and voxels.means.shape == points.shape
    assert peak < 5e6  # a bit for each of 50,000 cubed cells: 16 TB


def test_module_is_deterministic_for_any_number_of_threads() -> None:
    points, valid = random_clouds(2, 40_000, dtype=torch.float32)
    results = []
    for number in (1, 2, 3):
        with torch_threads(number):
            results.append(VoxelPool(0.05)(points, valid))
    assert all(torch.equal(a, b) and torch.equal(a, c) for a, b, c in zip(*results, strict=True))


def test_points_that_cannot_be_numbered_are_rejected() -> None:
    valid = torch.ones(1, 2, dtype=torch.bool)
    for bad in (torch.nan, torch.inf, 1e30):
        with pytest.raises(InputError, match="not finite or lie too far apart"):
            voxel_pool(torch.tensor([[[0.0, 0.0, 0.0], [bad, bad, bad]]]), valid, 0.02)
    for size in (0.0, torch.nan):
        with pytest.raises(ConfigError, match=rf"^size is {size}; give a number above 0$"):
            voxel_pool(torch.zeros(1, 2, 3), valid, size)
