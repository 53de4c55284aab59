"""Coordinate frames of the messages, according to REP 103 and REP 105 of ROS.

======================================  ============================================================================
``map``                                 Fixed frame of the map: the level frame (`level_frame`), with x forward from
                                        the first camera, y left, z up. While up is not known, the first camera counts
                                        as level.
``odom``                                Frame in which the camera moves without jumps; ``map`` to ``odom`` holds the
                                        corrections of the map. Its origin and its yaw are those of the first camera.
``camera_link``                         Colour camera with x forward, y left, z up.
``camera_color_optical_frame``          Colour camera with x right, y down, z forward: the camera frame of this package.
======================================  ============================================================================
"""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.geometry.level_frame import level_frame
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


def map_frame(T_lw: Tensor | None) -> Tensor:
    """Transform from the world frame of a run to ``map``, float64, shape :math:`(4, 4)`.

    Args:
        T_lw: Transform to the level frame, see `V3DSLAM.T_lw`; None while it is not known.
    """
    return T_LINK_OPTICAL if T_lw is None else T_lw


def camera_in_map(T_wc: Tensor, T_mw: Tensor) -> Tensor:
    """Pose of ``camera_link`` in ``map``.

    Args:
        T_wc: Camera-to-world poses, float64, shape :math:`(..., 4, 4)`.
        T_mw: Transform from the world frame to ``map``, float64, shape :math:`(4, 4)`.

    Returns:
        Transforms from ``camera_link`` to ``map``, float64, shape :math:`(..., 4, 4)`.
    """
    return T_mw @ T_wc @ invert(T_LINK_OPTICAL)


def points_in_map(points: Tensor, T_mw: Tensor) -> Tensor:
    """Transform points, or directions, from the world frame to ``map``, which has the same origin.

    Args:
        points: Points, world frame, metres, shape :math:`(..., 3)`.
        T_mw: Transform from the world frame to ``map``, float64, shape :math:`(4, 4)`.

    Returns:
        Points, metres, shape and dtype of ``points``.
    """
    return points @ T_mw[:3, :3].T.to(points.dtype)


class OdometryFrame:
    """Frame ``odom``: the product of the camera's motions, each as it is known one frame after the motion.

    It begins at the first camera, with its yaw, and with z up as in ``map`` at that time. The pose of a frame is
    refined once the motion to the next frame is known; the camera then moves by this correction of some millimetres,
    which would otherwise add up. When a loop moves the map, or when ``map`` is turned because up has become known, the
    camera stays where it is in ``odom``, and the pose of ``odom`` in ``map`` changes.

    Attributes:
        T_ol: Pose of ``camera_link`` in ``odom``, float64, shape :math:`(4, 4)`.
        T_mo: Pose of ``odom`` in ``map``, float64, shape :math:`(4, 4)`.
    """

    def __init__(self) -> None:
        self.T_ol = torch.eye(4, dtype=torch.float64)
        self.T_mo = torch.eye(4, dtype=torch.float64)
        self._T_oa: Tensor | None = None  # pose in ``odom`` of the frame before the previous one

    def update(self, T_ma: Tensor, T_mp: Tensor, T_ml: Tensor) -> None:
        """Move the camera to the next frame.

        Args:
            T_ma: Pose of ``camera_link`` at the frame before the previous one, in the current map, float64, shape
                :math:`(4, 4)`. At the first two frames it is that of the first.
            T_mp: The same at the previous frame; at the first frame that of this frame.
            T_ml: The same at this frame.
        """
        if self._T_oa is None:
            self._T_oa = level_frame((T_ml @ T_LINK_OPTICAL)[2, :3]) @ invert(T_LINK_OPTICAL)
        T_om = self._T_oa @ invert(T_ma)
        self.T_ol, self._T_oa = orthonormalise(T_om @ T_ml), orthonormalise(T_om @ T_mp)
        self.turn_map(T_ml)

    def turn_map(self, T_ml: Tensor) -> None:
        """Keep the camera where it is in ``odom``, although its pose in the map has changed.

        Args:
            T_ml: Pose of ``camera_link`` at the newest frame, in the current map, float64, shape :math:`(4, 4)`.
        """
        self.T_mo = T_ml @ invert(self.T_ol)
