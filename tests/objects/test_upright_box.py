"""Upright boxes of clouds: properties for random boxes, and the choice of the forward direction."""

from __future__ import annotations

import math

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.geometry.level_frame import level_frame
from v3d_torch.objects.upright_box import UprightBox, upright_boxes

UP = torch.tensor([0.1, -0.9, 0.2], dtype=torch.float64)
R_LW = level_frame(UP)[:3, :3]
AT_REST = torch.zeros(3, dtype=torch.float64)


def upright_box(cloud: Tensor, up: Tensor, velocity: Tensor) -> UprightBox:
    (box,) = upright_boxes([cloud], up, [velocity])
    return box


def cloud_of_box(centre: Tensor, size: Tensor, yaw: float) -> Tensor:
    """Return the corners and the centre of a box that stands upright, world frame, (9, 3); the centre is level."""
    corners = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5], dtype=torch.float64)] * 3) * size
    turn = torch.tensor(
        [[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]], dtype=torch.float64
    )
    return (torch.cat([corners, torch.zeros(1, 3, dtype=torch.float64)]) @ turn.T + centre) @ R_LW


@settings(max_examples=30)
@given(st.floats(-3, 3), st.floats(0.2, 1.0), st.floats(1.2, 3.0), st.floats(0.1, 2.0))
def test_box_of_corners_is_the_box(yaw: float, width: float, ratio: float, height: float) -> None:
    centre, size = torch.tensor([1.0, -2.0, 0.5]).double(), torch.tensor([width * ratio, width, height]).double()
    box = upright_box(cloud_of_box(centre, size, yaw), UP, AT_REST)
    torch.testing.assert_close(box.size, size, rtol=0.0, atol=1e-4)
    torch.testing.assert_close(R_LW @ box.T_wb[:3, 3], centre, rtol=0.0, atol=1e-4)
    torch.testing.assert_close(box.T_wb[:3, 2], R_LW[2], rtol=0.0, atol=1e-9)
    assert abs(math.remainder(box.yaw - yaw, math.pi)) < 1e-3 and abs(box.yaw) <= math.pi / 2 + 1e-9
    forward = R_LW @ box.T_wb[:3, 0]
    assert abs(math.remainder(math.atan2(forward[1], forward[0]) - box.yaw, 2 * math.pi)) < 1e-9


@settings(max_examples=30)
@given(st.floats(-3, 3), st.integers(0, 3), st.floats(-0.6, 0.6))
def test_moving_box_points_where_it_moves(yaw: float, quarter: int, beside: float) -> None:
    size = torch.tensor([1.0, 0.4, 1.5]).double()
    heading = yaw + quarter * math.pi / 2 + beside
    velocity = R_LW.T @ torch.tensor([math.cos(heading), math.sin(heading), 0.3], dtype=torch.float64)
    box = upright_box(cloud_of_box(torch.zeros(3).double(), size, yaw), UP, velocity)
    assert abs(math.remainder(box.yaw - (yaw + quarter * math.pi / 2), 2 * math.pi)) < 1e-3
    expected = [1.0, 0.4] if quarter % 2 == 0 else [0.4, 1.0]
    torch.testing.assert_close(box.size[:2], torch.tensor(expected).double(), rtol=0.0, atol=1e-4)


def test_object_that_moves_up_points_along_its_longer_side() -> None:
    size, velocity = torch.tensor([1.0, 0.4, 1.5]).double(), torch.tensor([0.0, -0.2, 1.0]).double()
    box = upright_box(cloud_of_box(torch.zeros(3).double(), size, 0.2), UP, R_LW.T @ velocity)
    assert abs(box.yaw - 0.2) < 1e-3
    torch.testing.assert_close(box.size, size, rtol=0.0, atol=1e-4)


def test_single_point_has_a_box_without_volume() -> None:
    box = upright_box(torch.tensor([[1.0, 2.0, 3.0]]), UP, AT_REST)
    torch.testing.assert_close(box.T_wb[:3, 3], torch.tensor([1.0, 2.0, 3.0]).double(), rtol=0.0, atol=1e-5)
    assert float(box.size.abs().max()) < 1e-5
