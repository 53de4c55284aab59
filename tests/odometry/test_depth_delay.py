"""Depth-delay compensation: the depth of features at the time of the colour image."""

from __future__ import annotations

import pytest
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
VELOCITY = torch.tensor([0.5, -0.4, 0.6, 0.9, -1.1, 1.3], dtype=torch.float64)  # m/s and rad/s
WALL = torch.tensor([0.4, 0.3, 1.0, 3.0], dtype=torch.float64)
"""Plane 0.4 x + 0.3 y + z = 3 m in the frame of the colour image."""


def wall_depth(T_depth_colour: Tensor) -> Tensor:
    """Depth image of the wall, metres, (1, H, W), from another pose than that of the colour image."""
    rays = CAMERA.back_project(pixels(), torch.ones(CAMERA.height * CAMERA.width, dtype=torch.float64))
    T_colour_depth = invert(T_depth_colour)
    slope, offset = rays @ T_colour_depth[:3, :3].T @ WALL[:3], T_colour_depth[:3, 3] @ WALL[:3]
    return ((WALL[3] - offset) / slope).reshape(1, CAMERA.height, CAMERA.width).to(torch.float32)


def pixels() -> Tensor:
    """(column, row) of all pixels, float64, (H * W, 2)."""
    row, column = torch.meshgrid(torch.arange(CAMERA.height), torch.arange(CAMERA.width), indexing="ij")
    return torch.stack([column, row], dim=-1).reshape(-1, 2).to(torch.float64)


def features_in(depth: Tensor, count: int = 300) -> Features:
    """Features at random pixels, with the depth of the image there."""
    u, v = torch.rand(2, count, generator=torch.Generator().manual_seed(5))
    pixel = torch.stack([80 + 480 * u, 80 + 320 * v], dim=1).round().to(torch.int64)
    octave = torch.zeros(count, dtype=torch.int64)
    z = sample_depth(pixel, depth, max_depth=8.0)
    return Features(pixel.double(), pixel, z, octave, torch.zeros(count, 32, dtype=torch.uint8))


@given(delay=st.floats(-0.02, 0.02), scale=st.floats(-1, 1))
@settings(max_examples=30)
def test_compensated_depth_is_that_of_the_colour_image(delay: float, scale: float) -> None:
    velocity, expected = scale * VELOCITY, features_in(wall_depth(torch.eye(4, dtype=torch.float64))).depth
    delayed = wall_depth(se3_exp(delay * velocity))
    compensated = DepthDelayCompensation(Config(), CAMERA)(features_in(delayed), delayed, velocity, delay)
    torch.testing.assert_close(compensated.depth, expected, rtol=0, atol=0.005)  # half a pixel on this wall is 3 mm


def test_uncompensated_depth_is_wrong_by_more() -> None:
    expected = features_in(wall_depth(torch.eye(4, dtype=torch.float64))).depth
    uncompensated = features_in(wall_depth(se3_exp(0.02 * VELOCITY))).depth
    assert float((uncompensated - expected).abs().max()) > 0.03


@pytest.mark.parametrize("forward", [1.0, -1.0])
@pytest.mark.parametrize("near", [1.0, 5.0])
def test_depth_beside_an_edge_moves_with_its_own_surface(near: float, forward: float) -> None:
    """The camera turns by ten pixels between the images; the left half of the scene has another depth."""
    velocity = torch.tensor([0.0, 0.0, -forward, 0.0, 1.0, 0.0], dtype=torch.float64)
    seen, delay = torch.full((1, CAMERA.height, CAMERA.width), near - forward * 0.02), 0.02
    seen[:, :, 331:] = 3.0 - forward * 0.02  # the edge at the time of the depth image
    pixel = torch.tensor([[column, 240] for column in range(322, 330)])
    none = torch.zeros(len(pixel), 32, dtype=torch.uint8)
    features = Features(pixel.double(), pixel, sample_depth(pixel, seen, 8.0), torch.zeros(len(pixel)).long(), none)
    found = DepthDelayCompensation(Config(), CAMERA)(features, seen, velocity, delay)
    assert float((found.depth - 3.0).abs().max()) < 0.003


def test_features_are_unchanged_without_delay_or_if_disabled() -> None:
    depth = wall_depth(torch.eye(4, dtype=torch.float64))
    features = features_in(depth)
    assert DepthDelayCompensation(Config(), CAMERA)(features, depth, VELOCITY, 0.0) is features
    disabled = Config.model_validate({"rolling_shutter": {"enabled": False}})
    assert DepthDelayCompensation(disabled, CAMERA)(features, depth, VELOCITY, 0.02) is features


def test_features_shifted_out_of_the_image_or_into_a_hole_have_no_depth() -> None:
    depth = wall_depth(torch.eye(4, dtype=torch.float64))
    depth[:, :, 320:] = 0
    rotation = torch.tensor([0, 0, 0, 0, 1.0, 0], dtype=torch.float64)  # points move right, 10 pixels in 20 ms
    pixel = torch.tensor([[0, 240], [100, 240], [312, 240], [325, 240], [639, 240]])
    octave = torch.zeros(5, dtype=torch.int64)
    features = Features(
        pixel.double(), pixel, sample_depth(pixel, depth, 8.0), octave, torch.zeros(5, 32, dtype=torch.uint8)
    )
    compensate = DepthDelayCompensation(Config(), CAMERA)
    assert (compensate(features, depth, rotation, 0.02).depth > 0).tolist() == [True, True, False, False, False]
    assert (compensate(features, depth, rotation, -0.02).depth > 0).tolist() == [False, True, True, True, False]
