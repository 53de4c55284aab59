"""ORB-SLAM3 (Campos et al., T-RO 2021) with RGB-D images, as the PyPI package pyorbslam3 builds it.

It runs without a window. It is not deterministic, because of its threads.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pyorbslam3
import torch

from v3d_torch.datasets import RGBDSequence
from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.distortion import COEFFICIENTS
from v3d_torch.types import Trajectory

VIEWER = (
    *("KeyFrameSize", "KeyFrameLineWidth", "GraphLineWidth", "PointSize", "CameraSize", "CameraLineWidth"),
    *("ViewpointX", "ViewpointY", "ViewpointZ", "ViewpointF"),
)
"""Settings of the window, which are required even without a window."""


class OrbSlam3:
    """System with ORB-SLAM3.

    Args:
        sequence: Sequence to run on.
        vocabulary: Vocabulary in DBoW2's text format.
        rate: Speed at which frames are given, relative to that of the recording: its mapping threads need time between
            the frames. None for full speed.
    """

    stages: Mapping[str, float] = {}

    def __init__(self, sequence: RGBDSequence, vocabulary: Path, rate: float | None = None) -> None:
        self._sequence = sequence
        self._rate = rate
        with TemporaryDirectory() as folder:
            path = Path(folder) / "settings.yaml"
            path.write_text(settings(sequence.camera, frame_rate(sequence)))
            self._slam = pyorbslam3.Slam(vocabulary, path, pyorbslam3.Sensor.RGBD)

    def __call__(self) -> None:
        """Track all frames. The call does not wait for the mapping threads."""
        start, first = time.monotonic(), float(self._sequence.stamps[0])
        for frame in self._sequence:
            if self._rate is not None:
                time.sleep(max(start + (frame.stamp - first) / self._rate - time.monotonic(), 0.0))
            self._slam.track_rgbd(frame.image.permute(1, 2, 0).numpy(), frame.depth[0].numpy(), frame.stamp)

    def trajectory(self) -> Trajectory:
        """Return the poses of the frames in its largest map, after all corrections.

        When it loses the camera, it starts a new map with a new world frame. EuRoC's format contains only the largest
        map; TUM's format mixes the world frames. Without a map there are no poses.
        """
        self._slam.shutdown()
        wait_for_threads()
        with TemporaryDirectory() as folder:
            path = Path(folder) / "trajectory.txt"
            self._slam.save_trajectory_euroc(str(path))
            if not path.is_file() or not path.read_text().strip():
                return Trajectory(torch.zeros(0, dtype=torch.float64), torch.zeros(0, 4, 4, dtype=torch.float64))
            # Nanoseconds since the start, which `read_trajectory` would interpret as Unix time.
            poses = np.loadtxt(path, ndmin=2)
            poses[:, 0] /= 1e9
            np.savetxt(path, poses, fmt="%.9f")
            return read_trajectory(path)


def wait_for_threads(pause: float = 0.5) -> None:
    """Wait until this process is idle, because ``shutdown`` does not wait for the threads."""
    busy = True
    while busy:
        start = time.process_time()
        time.sleep(pause)
        busy = time.process_time() - start > 0.02 * pause


def frame_rate(sequence: RGBDSequence) -> int:
    """Return the frame rate in Hz; ORB-SLAM3 inserts a keyframe at the latest after one second of frames."""
    return max(round(1 / float(sequence.stamps.diff().median())), 1)


def settings(camera: PinholeCamera, fps: int) -> str:
    """Return the settings file: the given camera, and all other values of ORB-SLAM3's example for TUM sequences.

    The depth factor is 1 because depth is passed in metres.
    """
    if camera.distortion_model != "plumb_bob":
        raise InputError(f"the system ORB-SLAM3 is not set up for the lens model {camera.distortion_model}")
    lens = dict(zip(COEFFICIENTS["plumb_bob"], camera.distortion, strict=True)) if camera.is_distorted else {}
    intrinsics = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy, **lens}
    return f"""%YAML:1.0
---
File.version: "1.0"
Camera.type: "PinHole"
{"".join(f"Camera1.{name}: {value:.9f}" + chr(10) for name, value in intrinsics.items())}\
Camera.width: {camera.width}
Camera.height: {camera.height}
Camera.fps: {fps}
Camera.RGB: 1
Stereo.ThDepth: 40.0
Stereo.b: 0.07732
RGBD.DepthMapFactor: 1.0
ORBextractor.nFeatures: 1000
ORBextractor.scaleFactor: 1.2
ORBextractor.nLevels: 8
ORBextractor.iniThFAST: 20
ORBextractor.minThFAST: 7
{"".join(f"Viewer.{name}: 1.0" + chr(10) for name in VIEWER)}"""
