"""Depth image with the pose of its camera, as the free-space check compares it, and the minimum depth around pixels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.kernels import nearest_depth as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array

_POSE_ERROR = 0.01
"""Reprojection error of a view's pose, as a fraction of the image width: 0.6 degrees of a Kinect's field of view."""


@dataclass(frozen=True)
class StoredView:
    """View that later frames are compared with.

    Attributes:
        stamp: Timestamp, seconds.
        nearest_depth: Minimum depth around each pixel, metres, float32, shape :math:`(H, W)`; 0 for a pixel without
            depth.
        T_dw: World-to-camera pose at the time of the depth image, float64, shape :math:`(4, 4)`.
    """

    stamp: float
    nearest_depth: Tensor
    T_dw: Tensor


@dataclass(frozen=True)
class DepthView:
    """Depth image of the current frame with its pose.

    Attributes:
        stamp: Timestamp, seconds.
        depth: Depth, metres, float32, shape :math:`(1, H, W)`; 0 = no measurement.
        T_dw: World-to-camera pose at the time of the depth image, float64, shape :math:`(4, 4)`.
        misalignment: Largest offset of the depth of a pixel from that pose, pixels. It arises when the camera turns
            while the image is read.
        is_motion_measured: True if the motion of the camera since the previous frame is measured; otherwise the pose is
            a guess.
    """

    stamp: float
    depth: Tensor
    T_dw: Tensor
    misalignment: int = 0
    is_motion_measured: bool = True

    @cached_property
    def missing(self) -> Tensor:
        """Pixels without depth, bool, shape :math:`(H, W)`."""
        return torch.from_numpy(self.depth[0].numpy() <= 0)  # NumPy is faster here than torch

    @cached_property
    def nearest_depth(self) -> Tensor:
        """Minimum depth around each pixel, metres, float32, shape :math:`(H, W)`; 0 for a pixel without depth.

        A position is free only if all measurements around it lie behind it. Otherwise a surface at a grazing angle, or
        a pose that is off by some pixels, would make static points appear or vacate.
        """
        return _nearest_depth(self.depth[0], round(_POSE_ERROR * self.depth.shape[2]) + self.misalignment)


SpaceView = DepthView | StoredView
"""View with which the free-space check compares points: of the current frame, or an earlier one."""


def erode_measured(depth: NDArray[np.float32], size: int) -> NDArray[np.float32]:
    """Return the minimum depth in a square around each pixel; pixels without depth are ignored.

    Args:
        depth: Depth, metres, shape :math:`(H, W)`; 0 = no measurement.
        size: Side of the square, pixels.

    Returns:
        Depth, metres, shape :math:`(H, W)`; the largest float32 if the square has no measurement.
    """
    no_depth = cv2.threshold(depth, 0, float(np.finfo(np.float32).max), cv2.THRESH_BINARY_INV)[1]
    return np.asarray(cv2.erode(depth + no_depth, np.ones((size, size), np.uint8)), np.float32)


def _nearest_depth_compiled(depth: Tensor, radius: int) -> Tensor:
    if depth.dtype != torch.float32:
        return NotImplemented
    return torch.from_numpy(kernels.nearest_depth(to_array(depth), radius))


@compiled_by(_nearest_depth_compiled)
def _nearest_depth(depth: Tensor, radius: int) -> Tensor:
    """Return the minimum depth within a radius of each pixel, (H, W); 0 for a pixel without depth."""
    array = depth.numpy()
    return torch.from_numpy(erode_measured(array, 2 * radius + 1) * (array > 0))
