"""The level frame: its axes for chosen and random up directions, batches and gradients."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.geometry.level_frame import level_frame
from v3d_torch.geometry.se3 import se3_exp

UP = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
"""Up in the image of a level camera: y points down."""

directions = st.lists(st.floats(-5, 5), min_size=3, max_size=3).map(lambda v: torch.tensor(v, dtype=torch.float64))


def turned(pitch: float = 0.0, roll: float = 0.0) -> Tensor:
    """Up in the frame of a level camera that was turned about its x axis and then about its optical axis, degrees."""
    twists = torch.zeros(2, 6, dtype=torch.float64)
    twists[0, 5], twists[1, 3] = math.radians(roll), -math.radians(pitch)
    T_roll, T_pitch = se3_exp(twists)
    return T_roll[:3, :3] @ T_pitch[:3, :3] @ UP


def test_convention_level_camera_has_x_forward_y_left_z_up() -> None:
    right, down, forward = torch.eye(3, dtype=torch.float64)
    R = level_frame(UP)[:3, :3]
    assert (R @ forward).tolist() == [1, 0, 0]
    assert (R @ -right).tolist() == [0, 1, 0]
    assert (R @ -down).tolist() == [0, 0, 1]


@given(directions)
def test_is_a_rotation_that_turns_up_to_z(up: Tensor) -> None:
    assume(float(up.norm()) > 1e-3)
    T_lw = level_frame(up)
    torch.testing.assert_close(T_lw[:3, :3] @ T_lw[:3, :3].T, torch.eye(3, dtype=torch.float64))
    assert float(torch.linalg.det(T_lw)) == pytest.approx(1)
    torch.testing.assert_close(T_lw[:3, :3] @ up, up.norm() * up.new_tensor([0, 0, 1]))
    assert T_lw[:3, 3].tolist() == [0, 0, 0] and T_lw[3].tolist() == [0, 0, 0, 1]


@given(directions, st.floats(0.1, 10))
def test_yaw_of_the_camera_is_zero_and_length_has_no_effect(up: Tensor, length: float) -> None:
    assume(float(up[:2].norm()) > 0.2 * float(up.norm()) > 1e-3)
    x, y, _ = level_frame(up)[:3, 2].tolist()  # the optical axis
    assert x > 0 and abs(y) < 1e-9
    torch.testing.assert_close(level_frame(length * up), level_frame(up))


@pytest.mark.parametrize("pitch", [-90, -85, -79, -40, 0, 40, 79, 85, 90])
def test_pitched_camera_keeps_its_right_axis(pitch: float) -> None:
    """Also if it looks straight up or down."""
    right = level_frame(turned(pitch=pitch))[:3, 0]
    torch.testing.assert_close(right, right.new_tensor([0, -1, 0]), atol=1e-12, rtol=0)


@pytest.mark.parametrize("roll", [-170, -90, 30, 90])
def test_rolled_camera_keeps_its_optical_axis(roll: float) -> None:
    forward = level_frame(turned(roll=roll))[:3, 2]
    torch.testing.assert_close(forward, forward.new_tensor([1, 0, 0]), atol=1e-12, rtol=0)


def test_batch_is_the_same_as_one_by_one() -> None:
    up = torch.randn(2, 5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    up[1, 2] = torch.tensor([0.05, 0.0, -1.0])
    single = torch.stack([torch.stack([level_frame(each) for each in row]) for row in up])
    assert torch.equal(level_frame(up), single)
    assert torch.equal(torch.vmap(torch.vmap(level_frame))(up), single)


def test_gradient_equals_finite_differences() -> None:
    up = torch.tensor([[0.2, -0.9, 0.3], [0.05, 0.02, -1.0]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(level_frame, up)
