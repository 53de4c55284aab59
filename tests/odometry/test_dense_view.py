"""Image pyramid of dense alignment: depth edges, level cameras, small images."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.rendered_planes import IDENTITY, LENS, WALL, render
from torch import Tensor

from v3d_torch.config import DenseOdometryConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.odometry.dense_aligner import DenseAligner


def test_pyramid_ignores_missing_depth_and_keeps_edges() -> None:
    camera = PinholeCamera(500.0, 500.0, 31.5, 31.5, 64, 64)
    depth = torch.zeros(1, 64, 64)
    depth[0, 0:2, 0:2] = torch.tensor([[2.0, 0.0], [0.0, 0.0]])  # one of four pixels is measured
    depth[0, 0:2, 2:4] = torch.tensor([[1.0, 1.0], [3.0, 3.0]])  # a person in front of a wall
    depth[0, 0:2, 4:6] = torch.tensor([[2.0, 2.02], [2.0, 2.02]])  # one surface
    static = torch.ones(64, 64, dtype=torch.bool)
    static[10, 10] = False
    view = DenseAligner(DenseOdometryConfig(halvings=(1, 0)), camera).view(torch.rand(1, 64, 64), depth, static)
    grey, inverse_depth = view.levels[1].channels
    expected = torch.tensor([1 / 2.0, 1 / 1.0, (1 / 2.0 + 1 / 2.02) / 2])
    torch.testing.assert_close(inverse_depth[0, :3], expected)
    assert inverse_depth[0, 3:].isnan().all() and inverse_depth[1:].isnan().all()
    assert grey.isnan().nonzero().tolist() == [[5, 5]]
    assert view.levels[0].channels[0].isnan().nonzero().tolist() == [[10, 10]]


def test_reference_points_project_to_their_pixels_on_every_level() -> None:
    """With half-pixel shifts between levels, odd image sizes and lens distortion."""
    camera = replace(LENS, width=639, height=477)

    def waves(points: Tensor, plane: int) -> Tensor:
        return 0.5 + 0.2 * torch.sin(4 * points[..., 0]) + 0.2 * torch.sin(4 * points[..., 1])

    image = render(IDENTITY, camera, WALL, waves)
    view = DenseAligner(DenseOdometryConfig(), camera).view(*image, torch.ones(477, 639, dtype=torch.bool))
    for level in view.levels.values():
        points, values = level.reference_points.points.double(), level.reference_points.values
        camera = level.level_camera.camera
        pixels = camera.distort(camera.project(points))
        column, row = pixels.round().long().unbind(dim=1)
        torch.testing.assert_close(level.channels[:, row, column], values)
        assert (values[0] - waves(points, 0)).abs().max() < 0.01


@pytest.mark.parametrize(("width", "height", "levels"), [(640, 480, {4, 2, 1}), (31, 23, {2, 1}), (3, 3, {0})])
def test_levels_too_small_for_the_image_are_skipped(width: int, height: int, levels: set[int]) -> None:
    camera = PinholeCamera(50.0, 50.0, (width - 1) / 2, (height - 1) / 2, width, height)
    grey, depth = torch.rand(1, height, width), torch.ones(1, height, width)
    view = DenseAligner(DenseOdometryConfig(), camera).view(grey, depth, torch.ones(height, width, dtype=torch.bool))
    assert view.levels.keys() == levels
