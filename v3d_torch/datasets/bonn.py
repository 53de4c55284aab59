"""Bonn RGB-D Dynamic (Palazzolo et al., IROS 2019): TUM layout with its own camera and marker-based ground truth."""

from __future__ import annotations

from pathlib import Path

import torch

from v3d_torch.datasets.cameras import CameraChoice
from v3d_torch.datasets.locate import is_tum
from v3d_torch.datasets.tum import TUMSequence
from v3d_torch.datasets.tum_writer import is_recorded_truth
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import orthonormalise
from v3d_torch.types import Trajectory

CAMERA = PinholeCamera(
    542.822841,
    542.576870,
    315.593520,
    237.756098,
    distortion=(0.039903, -0.099343, -0.000730, -0.000144, 0.0),
    depth_scale=5000.0,
)
"""Published camera of the dataset."""

_T_ROS = torch.tensor(
    [[-1, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]],
    dtype=torch.float64,
)
"""Published change of axes between the motion capture frame and the marker frame."""

_T_MARKERS_CAMERA = torch.tensor(
    [
        [1.0157, 0.1828, -0.2389, 0.0113],
        [0.0009, -0.8431, -0.6413, -0.0098],
        [-0.3009, 0.6147, -0.8085, 0.0111],
        [0, 0, 0, 1],
    ],
    dtype=torch.float64,
)
"""Published transform from the camera to the tracked markers. It is a rotation times 1.0593, and the scale is meant for
models built from the depth images. Poses use only the rotation and the translation."""


class BonnSequence(TUMSequence):
    """Sequence of Bonn RGB-D Dynamic, such as ``rgbd_bonn_crowd``, with ground truth of its camera.

    ``groundtruth.txt`` contains the poses of the markers, 2 cm from the camera. The published transforms convert them
    to camera poses. Most published results, and those of ``v3d-torch evaluate``, are computed from the unconverted
    file.

    Args:
        folder: Folder of the sequence.
        camera: Camera chosen by the user; None for the camera file in the folder, or else `CAMERA`.

    Raises:
        InputError: If the folder or one of its files is missing or invalid.
    """

    def __init__(self, folder: Path, camera: CameraChoice = None) -> None:
        super().__init__(folder, camera, published=lambda: CAMERA)
        if self.groundtruth is not None:
            self.groundtruth = camera_poses(self.groundtruth)


def is_bonn(path: Path) -> bool:
    """Check whether a folder is an original sequence of the dataset, by its name and content.

    The ground truth that ``v3d-torch record`` writes is already converted.
    """
    return "rgbd_bonn" in path.resolve().name.lower() and is_tum(path) and not is_recorded_truth(path)


def camera_poses(markers: Trajectory) -> Trajectory:
    """Convert poses of the markers to poses of the camera: ``T_ROS^-1 T T_ROS T_markers_camera``, without the scale."""
    T_markers_camera = orthonormalise(_T_MARKERS_CAMERA)
    return Trajectory(markers.stamps, _T_ROS.T @ markers.T_wc @ _T_ROS @ T_markers_camera)
