"""Intel RealSense cameras, live and from files that RealSense software recorded."""

from __future__ import annotations

from v3d_torch.datasets.realsense.realsense_camera import RealSenseCamera, open_realsense_camera
from v3d_torch.datasets.realsense.realsense_stream import (
    RealSenseStream,
    is_realsense_recording,
    open_realsense_recording,
)

__all__ = [
    "RealSenseCamera",
    "RealSenseStream",
    "is_realsense_recording",
    "open_realsense_camera",
    "open_realsense_recording",
]
