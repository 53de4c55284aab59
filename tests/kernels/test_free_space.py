"""The kernels of the free-space check equal their torch twins, on random and degenerate inputs."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from v3d_torch.config import FreeSpaceConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.kernels import compiler
from v3d_torch.kernels.compiler import TWINS
from v3d_torch.objects import free_space_check
from v3d_torch.objects.depth_view import DepthView

pytestmark = pytest.mark.skipif(not compiler.ENABLED, reason="numba is not installed, or V3D_KERNELS=torch is set")

CAMERAS = [
    PinholeCamera(52.0, 52.0, 31.5, 23.5, 64, 48),
    PinholeCamera(52.0, 52.0, 31.5, 23.5, 64, 48, distortion=(0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    PinholeCamera(52.0, 52.0, 31.5, 23.5, 64, 48, distortion=(0.45, -2.5, 0.0006, -0.0003, 1.4, 0.33, -2.3, 1.4)),
    PinholeCamera(32.0, 32.0, 31.5, 23.5, 64, 48, distortion=(-0.01, 0.02), distortion_model="equidistant"),
]


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("measured", [0.0, 0.8, 1.0])
@pytest.mark.parametrize("count", [0, 1, 3000])
def test_free_space_of_points_equals_its_twin(camera: PinholeCamera, measured: float, count: int) -> None:
    points = torch.from_numpy(np.random.default_rng(0).normal(0, 2, (count, 3)))
    points[:1] = torch.nan
    found, expected = (
        f(points, view(measured, 0.1), camera, FreeSpaceConfig())
        for f in TWINS[f"{free_space_check.__name__}.observe_free_space"]
    )
    assert torch.equal(found.nan_to_num(2), expected.nan_to_num(2))


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("stride", [1, 4, 5])
@pytest.mark.parametrize("measured", [0.0, 0.8])
def test_pixels_in_space_that_was_free_equal_their_twin(camera: PinholeCamera, stride: int, measured: float) -> None:
    rays = camera.rays[::stride, ::stride].reshape(-1, 3).T.to(torch.float64)
    earlier = [view(1.0, 0.1), None, view(0.5, 0.0)]
    found, expected = (
        f(view(measured, 0.0), earlier, rays, stride, camera, FreeSpaceConfig())
        for f in TWINS[f"{free_space_check.__name__}._was_free"]
    )
    assert torch.equal(found.nan_to_num(2), expected.nan_to_num(2))


def view(measured: float, shift: float) -> DepthView:
    """View with depths of 1.8 to 2.2 m, moved sideways by ``shift`` metres."""
    rng, T_cw = np.random.default_rng(1), torch.eye(4, dtype=torch.float64)
    T_cw[0, 3] = shift
    depth = rng.uniform(1.8, 2.2, (48, 64)) * (rng.random((48, 64)) < measured)
    return DepthView(0.0, torch.from_numpy(depth.astype(np.float32))[None], T_cw)
