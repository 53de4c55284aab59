"""Bonn RGB-D Dynamic (Palazzolo et al., IROS 2019): TUM layout, its own camera, ground truth of the markers."""

from __future__ import annotations

from pathlib import Path

import torch

from v3d_torch.datasets.cameras import CameraChoice, choose_camera
from v3d_torch.datasets.tum import TUMSequence, is_tum
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import rigid
from v3d_torch.types import Trajectory

CAMERA = PinholeCamera(
    542.822841, 542.576870, 315.593520, 237.756098, distortion=(0.039903, -0.099343, -0.000730, -0.000144, 0.0)
)
"""As published with the dataset; depth in 5000 units per metre."""

_T_ROS = torch.tensor(
    [[-1, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]],
    dtype=torch.float64,
)
"""The motion capture's axes to those of the markers' frame, as published."""

_T_MARKERS_CAMERA = torch.tensor(
    [
        [1.0157, 0.1828, -0.2389, 0.0113],
        [0.0009, -0.8431, -0.6413, -0.0098],
        [-0.3009, 0.6147, -0.8085, 0.0111],
        [0, 0, 0, 1],
    ],
    dtype=torch.float64,
)
"""Camera to the markers that motion capture follows, as published: a rotation times 1.0593, which is meant for models
built from the depth images; a pose takes the rotation and the offset."""


class BonnSequence(TUMSequence):
    """Frames of a folder such as ``rgbd_bonn_crowd``, with the poses of its camera as ground truth.

    ``groundtruth.txt`` holds the poses of the markers, 2 cm from the camera: the published transforms take them to the
    camera. Most published tables compare with the file as it stands, as ``python -m v3d_torch evaluate`` does.

    Args:
        folder: the sequence's folder.
        camera: the user's choice; None takes `CAMERA`, unless the folder holds a camera of its own.

    Raises:
        InputError: as `TUMSequence`.
    """

    def __init__(self, folder: Path, camera: CameraChoice = None) -> None:
        super().__init__(folder, choose_camera(camera, folder, CAMERA))
        if self.groundtruth is not None:
            self.groundtruth = camera_poses(self.groundtruth)


def is_bonn(path: Path) -> bool:
    """Whether a folder is called as the dataset's are and holds what they hold.

    One with a ``camera.yaml`` was written by ``python -m v3d_torch record``, its poses are the camera's.
    """
    return "rgbd_bonn" in path.resolve().name.lower() and is_tum(path) and not (path / "camera.yaml").is_file()


def camera_poses(markers: Trajectory) -> Trajectory:
    """Poses of the markers to poses of the camera: ``T_ROS^-1 T T_ROS T_markers_camera``, without the scale."""
    T_markers_camera = rigid(_T_MARKERS_CAMERA)
    return Trajectory(markers.stamps, _T_ROS.T @ markers.T_wc @ _T_ROS @ T_markers_camera)
