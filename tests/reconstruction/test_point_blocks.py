"""Points that a view can observe, against a check of all points."""

from __future__ import annotations

import pytest
import torch
from helpers.box_room import CAMERA, CRATE, looking_around, render
from torch import Tensor

from v3d_torch.config import FreeSpaceConfig
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.objects.depth_view import DepthView
from v3d_torch.objects.free_space_check import observe_free_space
from v3d_torch.reconstruction.point_blocks import PointBlocks


def view(T_wc: Tensor, far: float = 10.0) -> DepthView:
    depth = render(T_wc, CRATE)
    return DepthView(0.0, torch.where(depth < far, depth, 0.0), invert(T_wc))


def scattered_points(seed: int, extent: float) -> Tensor:
    """Points that are denser at the origin."""
    generator = torch.Generator().manual_seed(seed)
    return extent * (torch.rand(20_000, 3, generator=generator, dtype=torch.float64) - 0.5) ** 3


@pytest.mark.parametrize("tolerance", [0.01, 0.5])
@pytest.mark.parametrize("extent", [16.0, 160.0])
def test_no_point_that_a_view_observes_is_left_out(extent: float, tolerance: float) -> None:
    points, config = scattered_points(0, extent), FreeSpaceConfig(inverse_depth_tolerance=tolerance)
    blocks = PointBlocks(points)
    observed = left_out = 0
    for k, T_wc in enumerate(looking_around(24)):
        roll = se3_exp(torch.tensor([0.0, 0.0, 0.0, 0.3 * k, 0.0, 0.2 * k], dtype=torch.float64))
        depth_view = view(T_wc @ roll, far=10.0 if k % 2 else 1.5)
        state = observe_free_space(points, depth_view, CAMERA, config)
        rows = blocks.observable_by(depth_view, CAMERA, config)
        found = torch.full_like(state, torch.nan)
        found[rows] = observe_free_space(points[rows], depth_view, CAMERA, config)
        assert torch.equal(found.nan_to_num(2.0), state.nan_to_num(2.0)) and len(rows.unique()) == len(rows)
        observed += int((~state.isnan()).sum())
        left_out += len(points) - len(rows)
    assert observed > 1000 and left_out > 0.5 * 24 * len(points)


def test_no_points_have_no_blocks() -> None:
    blocks = PointBlocks(torch.zeros(0, 3, dtype=torch.float64))
    assert len(blocks.observable_by(view(looking_around(1)[0]), CAMERA, FreeSpaceConfig())) == 0
