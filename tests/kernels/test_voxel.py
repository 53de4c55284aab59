"""Voxel pooling of the kernel equals that of its torch twin."""

from __future__ import annotations

import pytest
import torch

from v3d_torch.geometry.voxel import voxel_pool
from v3d_torch.kernels import compiler
from v3d_torch.kernels.compiler import TWINS

pytestmark = pytest.mark.skipif(not compiler.ENABLED, reason="numba is not installed, or V3D_KERNELS=torch is set")

TWIN = TWINS[f"{voxel_pool.__module__}.{voxel_pool.__qualname__}"]


@pytest.mark.parametrize("far", [-(2.0**25), 2.0**25, -(2.0**24) - 2, 2.0**40])
def test_voxels_equal_those_of_the_twin_at_cells_that_single_precision_cannot_subtract(far: float) -> None:
    """Single precision has 24 bits; cells near the origin keep their distances to a far point."""
    points = torch.tensor([[far, 0.5, 0.5], *([k + 0.25, 0.5, 0.5] for k in range(8))], dtype=torch.float32)[None]
    valid = torch.ones(1, 9, dtype=torch.bool)
    found, expected = TWIN.compiled(points, valid, 1.0), TWIN.torch(points, valid, 1.0)
    for name in expected._fields:
        assert torch.equal(getattr(found, name), getattr(expected, name)), name
    assert found.counts.tolist() == [[1] * 9]
