"""Depth sampling, selection of features, their readout Jacobian and their noise."""

from __future__ import annotations

from dataclasses import replace

import torch
from helpers.rolling_camera import CAMERA, KINECT, VELOCITY, observe_rolling, points_in_view

from v3d_torch.config import Config
from v3d_torch.features.features import sample_depth, select_evenly, to_measurements
from v3d_torch.odometry.rolling_shutter import compensate_features


def test_sampled_depth_outside_the_image_is_zero() -> None:
    depth = torch.arange(12, dtype=torch.float32).reshape(1, 3, 4)
    pixel = torch.tensor([[0, 0], [3, 1], [-1, 1], [4, 1], [1, 3], [1, -1], [3, 2]])
    assert sample_depth(pixel, depth, max_depth=10).tolist() == [0, 7, 0, 0, 0, 0, 0]


def test_select_evenly_prefers_sparse_cells() -> None:
    generator = torch.Generator().manual_seed(0)
    crowded = torch.randint(0, 32, (500, 2), generator=generator)
    sparse = torch.randint(0, 640, (60, 2), generator=generator)
    pixel = torch.cat([crowded, sparse])
    selected = select_evenly(pixel, 80, 32)
    assert len(selected) == 80
    assert (selected >= 500).sum() >= 55  # nearly all of the sparse pixels; a few share a cell
    assert torch.equal(selected, selected.sort().values)
    assert torch.equal(select_evenly(pixel, 1000, 32), torch.arange(560))
    assert len(select_evenly(pixel, 0, 32)) == 0


def test_selected_features_keep_their_readout_jacobian() -> None:
    observed = observe_rolling(points_in_view(), VELOCITY, KINECT.seconds)
    compensated = compensate_features(observed, VELOCITY, KINECT, CAMERA)
    assert torch.equal(compensated[torch.tensor([3, 1])].readout_jacobian, compensated.readout_jacobian[[3, 1]])


def test_readout_jacobian_is_zero_by_default() -> None:
    observed = observe_rolling(points_in_view(), VELOCITY, KINECT.seconds)
    assert torch.equal(observed.readout_jacobian, torch.zeros_like(observed.uv))


def test_sigma_ratio_multiplies_the_configured_noise() -> None:
    config, observed = Config(), observe_rolling(points_in_view(), VELOCITY, 0.0)
    ratio = torch.linspace(0.5, 4, 2 * len(observed), dtype=torch.float64).reshape(-1, 2)
    given = to_measurements(observed, config.tracking, config.features)
    scaled = to_measurements(replace(observed, sigma_ratio=ratio), config.tracking, config.features)
    torch.testing.assert_close(scaled.pixel_sigma / given.pixel_sigma, ratio[:, 0])
    torch.testing.assert_close(scaled.inverse_depth_sigma / config.tracking.inverse_depth_sigma, ratio[:, 1])
    assert torch.equal(given.inverse_depth_sigma, torch.full_like(observed.depth, config.tracking.inverse_depth_sigma))
