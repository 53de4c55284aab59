"""Upright 3D boxes of objects: the smallest ones around their clouds that stand on the ground plane."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.geometry.level_frame import level_frame

_MIN_SPEED = 0.3
"""Speed from which a box points in the direction of the velocity, m/s: that of slower objects is mostly noise."""


@dataclass(frozen=True)
class UprightBox:
    """Box with vertical sides, rotated by the yaw.

    Attributes:
        T_wb: Pose of the box in the world, float64, shape :math:`(4, 4)`. The origin is the centre of the box, x points
            forward and z up.
        size: Length along x, width along y, height along z, metres, float64, shape :math:`(3,)`.
        yaw: Angle of x around the vertical, in the level frame of `level_frame`, radians, from -pi to pi.
    """

    T_wb: Tensor
    size: Tensor
    yaw: float


def upright_boxes(clouds: Sequence[Tensor], up: Tensor, velocities: Sequence[Tensor]) -> list[UprightBox]:
    """Compute the upright box of each cloud: the rectangle of minimum area around its top view, from bottom to top.

    Forward is the side of the rectangle nearest to the velocity. For an object that is slow it is along the longer
    side, and the yaw is from -pi/2 to pi/2.

    Args:
        clouds: Points of each of K objects, world frame, metres, shape :math:`(P_k, 3)`; at least one point each.
        up: Direction against gravity, world frame, shape :math:`(3,)`.
        velocities: Velocity of each object, world frame, m/s, float64, shape :math:`(3,)`.
    """
    R_lw = level_frame(up)[:3, :3].numpy()
    return [
        _upright_box(cloud.numpy(), R_lw, velocity.numpy()) for cloud, velocity in zip(clouds, velocities, strict=True)
    ]


def _upright_box(cloud: NDArray[np.floating], R_lw: NDArray[np.float64], velocity: NDArray[np.float64]) -> UprightBox:
    # NumPy is faster here than torch: a frame has tens of small clouds.
    level = cloud @ R_lw.T
    (x, y), (side, other), degrees = cv2.minAreaRect(level[:, :2].astype(np.float32))
    vx, vy, _ = (R_lw @ velocity).tolist()
    yaw = math.radians(degrees)
    if math.hypot(vx, vy) >= _MIN_SPEED:
        quarters = round((math.atan2(vy, vx) - yaw) / (math.pi / 2))
        yaw = math.remainder(yaw + quarters * math.pi / 2, 2 * math.pi)
    else:
        quarters = int(other > side)
        yaw = math.remainder(yaw + quarters * math.pi / 2, math.pi)
    length, width = (side, other) if quarters % 2 == 0 else (other, side)
    bottom, top = float(level[:, 2].min()), float(level[:, 2].max())
    cos, sin = math.cos(yaw), math.sin(yaw)
    T_wb = np.eye(4)
    T_wb[:3, :3] = R_lw.T @ np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    T_wb[:3, 3] = R_lw.T @ np.array([x, y, (bottom + top) / 2])
    size = torch.tensor([length, width, top - bottom], dtype=torch.float64)
    return UprightBox(torch.from_numpy(T_wb), size, yaw)
