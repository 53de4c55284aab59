"""Cameras of CameraInfo messages of ROS 1 and ROS 2."""

from __future__ import annotations

from typing import Any

import numpy as np

from v3d_torch.datasets.camera_fields import camera_from_fields
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.depth_scale import MILLIMETRES


def camera_from_info(info: Any, source: str, *, is_rectified: bool = False) -> PinholeCamera:
    """Return the camera of a message; its depth is in millimetres (REP 118).

    Args:
        info: ``sensor_msgs/CameraInfo``.
        source: Origin of the message, for error messages.
        is_rectified: True if the images are undistorted, so that they have the camera matrix of P, not of K.

    Raises:
        InputError: If the message states no valid camera, or an unknown distortion model.
    """
    return camera_from_fields(fields_of_info(info, is_rectified=is_rectified), source)


def fields_of_info(info: Any, *, is_rectified: bool) -> dict[str, Any]:
    """Return the fields of the camera of a message, unchecked, see `camera_from_info`."""
    # ROS 1 has field names in upper case, ROS 2 in lower case.
    K, D, P = (getattr(info, name if hasattr(info, name) else name.lower()) for name in "KDP")
    rows = (np.asarray(P).reshape(3, 4) if is_rectified else np.asarray(K).reshape(3, 3)).tolist()
    intrinsics = {"fx": rows[0][0], "fy": rows[1][1], "cx": rows[0][2], "cy": rows[1][2]}
    distortion, model = ([], "") if is_rectified else (np.asarray(D).tolist(), info.distortion_model)
    size = {"width": info.width, "height": info.height, "depth_scale": MILLIMETRES}
    return intrinsics | size | {"distortion": distortion, "distortion_model": model}
