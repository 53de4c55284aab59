"""Coordinate frames of the messages, according to REP 103 and REP 105 of ROS.

======================================  ============================================================================
``map``                                 Fixed frame of the map: x forward, y left and z up of the first camera. It is
                                        level if the first camera is level.
``odom``                                Frame in which the camera moves without jumps; the transform from ``map`` to
                                        ``odom`` contains the corrections of the map.
``camera_link``                         Colour camera with x forward, y left, z up.
``camera_color_optical_frame``          Colour camera with x right, y down, z forward: the camera frame of this package.
======================================  ============================================================================
"""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.geometry.se3 import invert, orthonormalise

MAP, ODOM = "map", "odom"
CAMERA, OPTICAL = "camera_link", "camera_color_optical_frame"

T_LINK_OPTICAL = torch.tensor(
    [
        [0.0, 0, 1, 0],
        [-1, 0, 0, 0],
        [0, -1, 0, 0],
        [0, 0, 0, 1],
    ],  # x right, y down, z forward to x forward, y left, z up
    dtype=torch.float64,
)
"""Transform from ``camera_color_optical_frame`` to ``camera_link``, float64, shape :math:`(4, 4)`."""

T_MAP_WORLD = T_LINK_OPTICAL
"""Transform from the world frame of a run, the optical frame of its first camera, to ``map``."""


def camera_in_map(T_wc: Tensor) -> Tensor:
    """Pose of ``camera_link`` in ``map``.

    Args:
        T_wc: Camera-to-world poses, float64, shape :math:`(..., 4, 4)`.

    Returns:
        Transforms from ``camera_link`` to ``map``, float64, shape :math:`(..., 4, 4)`.
    """
    return T_MAP_WORLD @ T_wc @ invert(T_LINK_OPTICAL)


def points_in_map(points: Tensor) -> Tensor:
    """Transform points from the world frame to ``map``.

    Args:
        points: Points, world frame, metres, shape :math:`(..., 3)`.

    Returns:
        Points, metres, shape :math:`(..., 3)`.
    """
    x, y, z = points.unbind(dim=-1)
    return torch.stack([z, -x, -y], dim=-1)  # the rotation of T_MAP_WORLD


class OdometryFrame:
    """Frame ``odom``: the product of the camera's motions, each measured in the map at the time of the motion.

    Its origin is the first frame. When bundle adjustment or a loop moves the map, the pose of the camera in ``odom``
    stays the same, and the pose of ``odom`` in ``map`` changes.

    Attributes:
        T_ol: Pose of ``camera_link`` in ``odom``, float64, shape :math:`(4, 4)`.
        T_mo: Pose of ``odom`` in ``map``, float64, shape :math:`(4, 4)`.
    """

    def __init__(self) -> None:
        self.T_ol = torch.eye(4, dtype=torch.float64)
        self.T_mo = torch.eye(4, dtype=torch.float64)

    def update(self, T_mp: Tensor, T_ml: Tensor) -> None:
        """Move the camera to the next frame.

        Args:
            T_mp: Pose of ``camera_link`` at the previous frame, in the current map, float64, shape :math:`(4, 4)`; at
                the first frame the pose of this frame.
            T_ml: Pose of ``camera_link`` at this frame, in the current map, float64, shape :math:`(4, 4)`.
        """
        self.T_ol = orthonormalise(self.T_ol @ invert(T_mp) @ T_ml)
        self.T_mo = T_ml @ invert(self.T_ol)
