"""The kernel of the surface centroids equals its torch twin, on random and degenerate inputs."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from v3d_torch.config import CloudConfig
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.kernels import compiler
from v3d_torch.kernels.compiler import TWINS
from v3d_torch.objects import surface_centroids

pytestmark = pytest.mark.skipif(not compiler.ENABLED, reason="numba is not installed, or V3D_KERNELS=torch is set")

CAMERA = PinholeCamera(fx=80.0, fy=80.0, cx=40.0, cy=30.0, width=81, height=61)
MEANS = TWINS[f"{surface_centroids.__name__}._surface_means"]


@pytest.mark.parametrize("stride", [1, 4, 7])
@pytest.mark.parametrize("seed", range(6))
def test_means_of_surfaces_equal_their_twin(seed: int, stride: int) -> None:
    rng = np.random.default_rng(seed)
    depth = np.where(rng.random((61, 81)) < 0.1, 0, 1.5 + rng.integers(0, 4, (61, 1)) * 0.3 + 0.02 * rng.random(81))
    depth[rng.random(depth.shape) < 0.05] = 9.0  # beyond the range
    depth[rng.random(depth.shape) < 0.05] = np.nan
    depth[:, 70:] = 0.0
    masks = torch.from_numpy(rng.random((4, 61, 81)) < np.array([0.0, 0.01, 0.3, 1.0])[:, None, None])
    masks[1, :, :70] = False  # no pixel has a depth
    rays = CAMERA.rays[::stride, ::stride].reshape(-1, 3).numpy()
    arguments = torch.from_numpy(depth.astype(np.float32)), [*masks], rays, CloudConfig(stride=stride)
    found, expected = MEANS.compiled(*arguments), MEANS.torch(*arguments)
    assert [each is None for each in found] == [each is None for each in expected] == [True, True, False, False]
    for a, b in zip(found[2:], expected[2:], strict=True):
        np.testing.assert_array_equal(a, b)
    assert MEANS.compiled(arguments[0], [], *arguments[2:]) == MEANS.torch(arguments[0], [], *arguments[2:]) == []


def test_rays_that_are_not_finite_are_left_to_torch() -> None:
    rays = np.full((61 * 81, 3), np.nan, np.float32)
    arguments = torch.ones(61, 81), [torch.ones(61, 81, dtype=torch.bool)], rays, CloudConfig(stride=1)
    assert MEANS.compiled(*arguments) is NotImplemented
    with pytest.raises(InputError):
        MEANS.torch(*arguments)
    assert MEANS.compiled(arguments[0].double(), *arguments[1:]) is NotImplemented
