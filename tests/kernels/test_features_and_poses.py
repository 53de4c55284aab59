"""Kernels of features and measurements give the same results as their twins, also on degenerate inputs."""

from __future__ import annotations

import pytest
import torch

import v3d_torch.odometry.rolling_shutter  # noqa: F401 - registers the kernel
from v3d_torch.config import Config
from v3d_torch.features.features import Features
from v3d_torch.features.projection_matcher import LocalMap, ProjectionMatcher
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.kernels import compiler
from v3d_torch.kernels.compiler import TWINS
from v3d_torch.odometry.depth_delay import DepthDelayCompensation
from v3d_torch.optim.reprojection import Measurements

pytestmark = pytest.mark.skipif(not compiler.ENABLED, reason="numba is not installed, or V3D_KERNELS=torch is set")

CAMERA = PinholeCamera(80.0, 82.0, 31.5, 23.5, width=64, height=48)
COUNTS = [0, 1, 300]


def features(count: int) -> Features:
    """Features, some of which lie outside the image or have no depth."""
    generator = torch.Generator().manual_seed(count)
    uv = torch.rand(count, 2, generator=generator, dtype=torch.float64) * 80 - 8
    depth = (torch.rand(count, generator=generator, dtype=torch.float64) * 4 - 1).clamp(min=0)
    jacobian = torch.randn(count, 2, generator=generator, dtype=torch.float64)
    octave, descriptors = torch.zeros(count, dtype=torch.int64), torch.zeros(count, 32, dtype=torch.uint8)
    return Features(uv, uv.round().to(torch.int64), depth, octave, descriptors, jacobian)


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("speed", [0.0, 0.3, 100.0])
def test_compensation_equals_its_twin(count: int, speed: float) -> None:
    generator = torch.Generator().manual_seed(1)
    velocity = speed * torch.randn(6, generator=generator, dtype=torch.float64)
    depth = (torch.rand(1, 48, 64, generator=generator) * 10 - 1).clamp(min=0)
    depth[0, 5, :] = torch.nan
    for delay in (0.0, 0.02, -0.02):
        args = DepthDelayCompensation(Config(), CAMERA), features(count), depth, velocity, delay
        twin = TWINS["v3d_torch.odometry.depth_delay.DepthDelayCompensation.__call__"]
        found, expected = twin.compiled(*args), twin.torch(*args)
        torch.testing.assert_close(found.depth, expected.depth, rtol=1e-9, atol=1e-12)
    for readout in (0.0, 0.02, -0.02):
        given = features(count)
        rows = given.pixel[:, 1], given.inverse_depth
        shutter = given.uv, *rows, velocity, readout, CAMERA.K, CAMERA.height, given.readout_jacobian
        twin = TWINS["v3d_torch.odometry.rolling_shutter.compensate_rolling_shutter"]
        for found, expected in zip(twin.compiled(*shutter), twin.torch(*shutter), strict=True):
            torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("is_number", [True, False], ids=["number", "tensor"])
def test_whitening_equals_its_twin_to_the_bit(is_number: bool, count: int) -> None:
    given = features(count)
    sigma = torch.linspace(0.5, 4, count, dtype=torch.float64)
    measured = Measurements(
        uv=given.uv,
        inverse_depth=given.inverse_depth,
        pixel_sigma=sigma,
        inverse_depth_sigma=0.007 if is_number else 0.007 * sigma.flip(0),
    )
    twin = TWINS["v3d_torch.optim.reprojection.whiten"]
    found, expected = twin.compiled(measured, CAMERA.K), twin.torch(measured, CAMERA.K)
    assert torch.equal(found.scale, expected.scale) and torch.equal(found.offset, expected.offset)


@pytest.mark.parametrize("count", COUNTS)
def test_projection_of_a_local_map_equals_its_twin(count: int) -> None:
    generator = torch.Generator().manual_seed(2)
    points = torch.randn(count, 3, generator=generator, dtype=torch.float64) * 3
    if count > 2:
        points[0], points[1] = 0.0, torch.nan
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64))
    distance = torch.rand(count, generator=generator, dtype=torch.float64) * 8
    local_map = LocalMap(torch.arange(count), points, directions, distance, torch.zeros(count, 32, dtype=torch.uint8))
    matcher = ProjectionMatcher(Config().tracking, Config().features, CAMERA)
    twin = TWINS["v3d_torch.features.projection_matcher.ProjectionMatcher.project"]
    for T_cw in (torch.eye(4, dtype=torch.float64), se3_exp(torch.full((6,), 0.1, dtype=torch.float64))):
        found, expected = twin.compiled(matcher, T_cw, local_map), twin.torch(matcher, T_cw, local_map)
        assert torch.equal(found.indices, expected.indices) and torch.equal(found.octave, expected.octave)
        torch.testing.assert_close(found.uv, expected.uv, rtol=1e-12, atol=1e-10)
        torch.testing.assert_close(found.depth, expected.depth, rtol=1e-12, atol=1e-12)
        assert count < 300 or len(found.indices)


@pytest.mark.parametrize("scale", [0.0, 1e-9, 1e-5, 1e-3, 0.1, 1.0, 3.1])
@pytest.mark.parametrize("name", ["invert", "orthonormalise", "se3_exp", "se3_log"])
def test_single_rigid_motions_equal_their_twins(name: str, scale: float) -> None:
    twin = TWINS[f"v3d_torch.geometry.se3.{name}"]
    directions = torch.randn(30, 6, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    for xi in scale * torch.nn.functional.normalize(directions):
        given = xi if name == "se3_exp" else se3_exp(xi)
        torch.testing.assert_close(twin.compiled(given), twin.torch(given), rtol=1e-13, atol=1e-13)


def test_singular_matrices_are_left_to_the_twin() -> None:
    twin = TWINS["v3d_torch.geometry.se3.orthonormalise"]
    singular = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    singular[1] = 0.0
    assert twin.compiled(singular) is NotImplemented and twin.compiled(singular[1]) is NotImplemented
    mirrored = torch.diag(torch.tensor([-1.0, 2.0, 0.5, 1.0], dtype=torch.float64))
    torch.testing.assert_close(twin.compiled(mirrored), twin.torch(mirrored))
