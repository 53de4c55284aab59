"""The kernels from masks to instance clouds against their torch twins on random and degenerate inputs."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.random import Generator
from torch import Tensor

from v3d_torch.config import CloudConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.voxel import voxel_pool
from v3d_torch.kernels import compiler
from v3d_torch.kernels.compiler import TWINS
from v3d_torch.objects import instance_clouds
from v3d_torch.objects.dbscan import dbscan

pytestmark = pytest.mark.skipif(not compiler.ENABLED, reason="numba is not installed, or V3D_KERNELS=torch is set")

VOXEL_POOL, DBSCAN = TWINS[f"{voxel_pool.__module__}.voxel_pool"], TWINS[f"{dbscan.__module__}.dbscan"]
CLOUDS = TWINS[f"{instance_clouds.__name__}._compute_clouds"]
CAMERA = PinholeCamera(fx=80.0, fy=80.0, cx=40.0, cy=30.0, width=81, height=61)


def random_clouds(rng: Generator) -> tuple[Tensor, Tensor]:
    """Clouds that fill space, lie in a plane or a line, or coincide; some on a grid, so that distances are equal."""
    shape = rng.integers(1, 4), rng.integers(1, 300)
    points = rng.normal(size=(*shape, 3)) * rng.choice([0.05, 0.2, 1.0, 5.0]) * rng.choice([0.0, 0.01, 1.0], 3)
    if rng.random() < 0.4:
        points = np.round(points / 0.02) * 0.02
    valid = rng.random(shape) < rng.choice([0.0, 0.1, 0.9, 1.0])
    points[~valid] = np.nan
    return torch.from_numpy(points.astype(np.float32)), torch.from_numpy(valid)


@pytest.mark.parametrize("seed", range(40))
def test_voxels_equal_their_twin(seed: int) -> None:
    points, valid = random_clouds(np.random.default_rng(seed))
    for size in (0.02, 0.1, 3.0):
        results = VOXEL_POOL.compiled(points, valid, size), VOXEL_POOL.torch(points, valid, size)
        for found, expected in zip(*results, strict=True):
            assert found.dtype == expected.dtype
            assert torch.equal(found, expected)


@pytest.mark.parametrize("seed", range(40))
def test_clusters_equal_their_twin(seed: int) -> None:
    points, valid = random_clouds(np.random.default_rng(seed))
    points = points.to(torch.float64) if seed % 2 else points
    for eps in (0.04, 0.08, 0.3):
        for min_samples in (1, 2, 5, 12, 60):
            found = DBSCAN.compiled(points, valid, eps, min_samples)
            assert torch.equal(found, DBSCAN.torch(points, valid, eps, min_samples))


def test_clouds_beyond_the_range_of_the_kernels_are_left_to_torch() -> None:
    points, valid = torch.tensor([[[0.0, 0.0, 0.0], [1e7, 0.0, 0.0]]]), torch.ones(1, 2, dtype=torch.bool)
    assert DBSCAN.compiled(points, valid, 0.1, 1) is NotImplemented
    assert dbscan(points, valid, 0.1, 1).tolist() == [[0, 1]]
    for value in (torch.nan, torch.inf):
        points[0, 1] = value
        assert DBSCAN.compiled(points, valid, 0.1, 1) is NotImplemented
        assert VOXEL_POOL.compiled(points, valid, 0.1) is NotImplemented
    assert VOXEL_POOL.compiled(points[:, :1].to(torch.float64), valid[:, :1], 0.1) is NotImplemented


@pytest.mark.parametrize("stride", [1, 4, 7])
@pytest.mark.parametrize("count", [0, 1, 3])
@pytest.mark.parametrize("seed", range(4))
def test_instance_clouds_equal_their_twin(seed: int, count: int, stride: int) -> None:
    rng = np.random.default_rng(seed)
    depth = np.where(rng.random((61, 81)) < 0.1, 0, 1.5 + rng.integers(0, 4, (61, 1)) * 0.7 + 0.02 * rng.random(81))
    depth[rng.random(depth.shape) < 0.05] = 9.0  # beyond the range
    masks = np.zeros((count, 61, 81), np.bool_)
    for mask in masks[: max(count - 1, 1)]:  # of three masks, the last one is empty
        row, column = rng.integers(0, 40, 2)
        mask[row : row + 30, column : column + 40] = rng.random() < 0.9
    config = CloudConfig(stride=stride)
    rays = CAMERA.rays[::stride, ::stride].reshape(-1, 3).numpy()
    arguments = torch.from_numpy(depth.astype(np.float32)), torch.from_numpy(masks), rays, config
    found, expected = CLOUDS.compiled(*arguments), CLOUDS.torch(*arguments)
    for name, value in vars(expected).items():
        torch.testing.assert_close(getattr(found, name), value, rtol=0, atol=0, equal_nan=True)
