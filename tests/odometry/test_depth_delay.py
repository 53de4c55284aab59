"""Depth measured at another time than colour: features get the depth that they had when colour was taken."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.features.features import Features, sample_depth
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.odometry.depth_delay import DepthDelayCompensation

CAMERA = PinholeCamera(525.0, 520.0, 320.0, 240.0)
SHAKE = torch.tensor([0.5, -0.4, 0.6, 0.9, -1.1, 1.3], dtype=torch.float64)  # m/s and rad/s
WALL = torch.tensor([0.4, 0.3, 1.0, 3.0], dtype=torch.float64)  # 0.4 x + 0.3 y + z = 3 m when colour is taken


def wall_depth(T_now_colour: Tensor) -> Tensor:
    """Depth image of the wall, metres, (1, H, W), from another place than colour was taken from."""
    rays = CAMERA.back_project(pixels(), torch.ones(CAMERA.height * CAMERA.width, dtype=torch.float64))
    T_colour_now = invert(T_now_colour)
    along, offset = rays @ T_colour_now[:3, :3].T @ WALL[:3], T_colour_now[:3, 3] @ WALL[:3]
    return ((WALL[3] - offset) / along).reshape(1, CAMERA.height, CAMERA.width).to(torch.float32)


def pixels() -> Tensor:
    """(column, row) of all pixels, float64, (H * W, 2)."""
    row, column = torch.meshgrid(torch.arange(CAMERA.height), torch.arange(CAMERA.width), indexing="ij")
    return torch.stack([column, row], dim=-1).reshape(-1, 2).to(torch.float64)


def features_in(depth: Tensor, count: int = 300) -> Features:
    """Features at some pixels, with the depth that lies there."""
    u, v = torch.rand(2, count, generator=torch.Generator().manual_seed(5))
    pixel = torch.stack([80 + 480 * u, 80 + 320 * v], dim=1).round().to(torch.int64)
    number = torch.zeros(count, dtype=torch.int64)
    z = sample_depth(pixel, depth, max_depth=8.0)
    return Features(pixel.double(), pixel, z, number, torch.zeros(count, 32, dtype=torch.uint8))


@given(delay=st.floats(-0.02, 0.02), swing=st.floats(-1, 1))
@settings(deadline=None, max_examples=30)
def test_features_get_the_depth_of_their_own_time(delay: float, swing: float) -> None:
    velocity, truth = swing * SHAKE, features_in(wall_depth(torch.eye(4, dtype=torch.float64))).depth
    late = wall_depth(se3_exp(delay * velocity))
    taken_along = DepthDelayCompensation(Config(), CAMERA)(features_in(late), late, velocity, delay)
    torch.testing.assert_close(taken_along.depth, truth, rtol=0, atol=0.005)  # a pixel's half on this wall is 3 mm


def test_it_matters() -> None:
    truth = features_in(wall_depth(torch.eye(4, dtype=torch.float64))).depth
    as_read = features_in(wall_depth(se3_exp(0.02 * SHAKE))).depth
    assert float((as_read - truth).abs().max()) > 0.03


def test_nothing_changes_without_a_delay_or_without_a_shutter() -> None:
    depth = wall_depth(torch.eye(4, dtype=torch.float64))
    features = features_in(depth)
    assert DepthDelayCompensation(Config(), CAMERA)(features, depth, SHAKE, 0.0) is features
    off = Config.model_validate({"shutter": {"enabled": False}})
    assert DepthDelayCompensation(off, CAMERA)(features, depth, SHAKE, 0.02) is features


def test_what_was_outside_the_image_or_unmeasured_has_no_depth() -> None:
    depth = wall_depth(torch.eye(4, dtype=torch.float64))
    depth[:, :, 320:] = 0
    turn = torch.tensor([0, 0, 0, 0, 1.0, 0], dtype=torch.float64)  # points go right, 10 pixels in 20 ms
    pixel = torch.tensor([[0, 240], [100, 240], [312, 240], [325, 240], [639, 240]])
    number = torch.zeros(5, dtype=torch.int64)
    features = Features(
        pixel.double(), pixel, sample_depth(pixel, depth, 8.0), number, torch.zeros(5, 32, dtype=torch.uint8)
    )
    late = DepthDelayCompensation(Config(), CAMERA)
    assert (late(features, depth, turn, 0.02).depth > 0).tolist() == [True, True, False, False, False]
    assert (late(features, depth, turn, -0.02).depth > 0).tolist() == [False, True, True, True, False]


def test_depth_under_pixels() -> None:
    depth = torch.arange(12, dtype=torch.float32).reshape(1, 3, 4)
    pixel = torch.tensor([[0, 0], [3, 1], [-1, 1], [4, 1], [1, 3], [1, -1], [3, 2]])
    assert sample_depth(pixel, depth, max_depth=10).tolist() == [0, 7, 0, 0, 0, 0, 0]
