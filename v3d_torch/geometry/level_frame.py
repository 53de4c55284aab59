"""The level frame: the world turned so that z points up."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import normalize

from v3d_torch.geometry.se3 import to_matrix

_STEEP = math.radians(10)
"""Angle to the vertical below which the optical axis of the first camera has no clear horizontal direction."""


def level_frame(up: Tensor) -> Tensor:
    """Transform from the world to the level frame: z up, x forward, y left (REP 103 of ROS).

    The world frame is that of the first camera (x right, y down, z forward). The level frame has the same origin, and
    the yaw of the first camera is 0: its optical axis has no component along y. If the camera looks up or down, within
    10 degrees, x is the direction in which the camera would look if it were raised or lowered to the horizon.

    Args:
        up: Directions against gravity, world frame, of any length above 0, shape :math:`(..., 3)`.

    Returns:
        Rotations without translation, float64, shape :math:`(..., 4, 4)`. They are differentiable in ``up``.
    """
    z = normalize(up.to(torch.float64), dim=-1)
    ahead, below = z.new_tensor([0.0, 0.0, 1.0]), z.new_tensor([0.0, 1.0, 0.0])
    is_steep = z[..., 2:].abs() > math.cos(_STEEP)
    forward = torch.where(is_steep, below * z[..., 2:].sign(), ahead)
    x = normalize(forward - (forward * z).sum(dim=-1, keepdim=True) * z, dim=-1)
    R = torch.stack([x, torch.linalg.cross(z, x), z], dim=-2)
    return to_matrix(R, torch.zeros_like(z))
