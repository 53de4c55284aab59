"""Upright 3D box of an object: the smallest one around its cloud that stands on the ground plane."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from v3d_torch.geometry.level_frame import level_frame

_MIN_SPEED = 0.3
"""Speed from which a box points in the direction of the velocity, m/s: that of slower objects is mostly noise."""


@dataclass(frozen=True)
class UprightBox:
    """Box with two vertical axes planes, turned by the yaw.

    Attributes:
        T_wb: Pose of the box in the world, float64, shape :math:`(4, 4)`. The origin is the centre of the box, x points
            forward and z up.
        size: Length along x, width along y, height along z, metres, float64, shape :math:`(3,)`.
        yaw: Angle of x around the vertical, in the level frame of `level_frame`, radians, from -pi to pi.
    """

    T_wb: Tensor
    size: Tensor
    yaw: float


def upright_box(cloud: Tensor, up: Tensor, velocity: Tensor) -> UprightBox:
    """Compute the upright box of a cloud: the rectangle of minimum area around its top view, from bottom to top.

    Forward is the side of the rectangle nearest to the velocity. For an object that is slow it is along the longer
    side, and the yaw is from -pi/2 to pi/2.

    Args:
        cloud: Points, world frame, metres, float32 or float64, shape :math:`(P, 3)`; at least one.
        up: Direction against gravity, world frame, shape :math:`(3,)`.
        velocity: Velocity, world frame, m/s, float64, shape :math:`(3,)`.
    """
    R_lw = level_frame(up)[:3, :3]
    level = cloud.to(torch.float64) @ R_lw.T
    (x, y), (side, other), degrees = cv2.minAreaRect(level[:, :2].to(torch.float32).numpy())
    vx, vy, _ = (R_lw @ velocity).tolist()
    yaw = math.radians(degrees)
    if math.hypot(vx, vy) >= _MIN_SPEED:
        quarters = round((math.atan2(vy, vx) - yaw) / (math.pi / 2))
        yaw = math.remainder(yaw + quarters * math.pi / 2, 2 * math.pi)
    else:
        quarters = int(other > side)
        yaw = math.remainder(yaw + quarters * math.pi / 2, math.pi)
    length, width = (side, other) if quarters % 2 == 0 else (other, side)
    bottom, top = level[:, 2].amin(), level[:, 2].amax()
    R_lb = torch.from_numpy(np.asarray(cv2.Rodrigues(np.array([0.0, 0.0, yaw]))[0]))
    T_wb = torch.eye(4, dtype=torch.float64)
    T_wb[:3, :3] = R_lw.T @ R_lb
    T_wb[:3, 3] = R_lw.T @ torch.stack([level.new_tensor(x), level.new_tensor(y), (bottom + top) / 2])
    return UprightBox(T_wb, torch.stack([level.new_tensor(length), level.new_tensor(width), top - bottom]), yaw)
