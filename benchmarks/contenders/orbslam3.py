"""ORB-SLAM3 (Campos et al., T-RO 2021) with RGB-D images, as the PyPI package pyorbslam3 builds it.

It runs as fast as it goes, without a window. Its threads make it give another trajectory every time.
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
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.types import Trajectory

VIEWER = (
    *("KeyFrameSize", "KeyFrameLineWidth", "GraphLineWidth", "PointSize", "CameraSize", "CameraLineWidth"),
    *("ViewpointX", "ViewpointY", "ViewpointZ", "ViewpointF"),
)
"""Settings of the window, which must be there though there is none."""


class OrbSlam3:
    """A contender.

    Args:
        sequence: to run on.
        vocabulary: in DBoW2's text format.
    """

    stages: Mapping[str, float] = {}

    def __init__(self, sequence: RGBDSequence, vocabulary: Path) -> None:
        self._sequence = sequence
        with TemporaryDirectory() as folder:
            path = Path(folder) / "settings.yaml"
            path.write_text(settings(sequence.camera, frames_a_second(sequence)))
            self._slam = pyorbslam3.Slam(vocabulary, path, pyorbslam3.Sensor.RGBD)

    def __call__(self) -> None:
        """Track all frames. What its threads still map then is not waited for."""
        for frame in self._sequence:
            self._slam.track_rgbd(frame.image.permute(1, 2, 0).numpy(), frame.depth[0].numpy(), frame.stamp)

    def trajectory(self) -> Trajectory:
        """Poses of the frames in its largest map, after all its corrections.

        Where it loses the camera it begins a map with a world of its own. EuRoC's format leaves out all maps but the
        largest, TUM's mixes the worlds. No map makes no poses.
        """
        self._slam.shutdown()
        wait_for_threads()
        with TemporaryDirectory() as folder:
            path = Path(folder) / "trajectory.txt"
            self._slam.save_trajectory_euroc(str(path))
            if not path.is_file() or not path.read_text().strip():
                return Trajectory(torch.zeros(0, dtype=torch.float64), torch.zeros(0, 4, 4, dtype=torch.float64))
            # Nanoseconds of any origin: read as they are, they would be taken for those of a clock.
            poses = np.loadtxt(path, ndmin=2)
            poses[:, 0] /= 1e9
            np.savetxt(path, poses, fmt="%.9f")
            return read_trajectory(path)


def wait_for_threads(pause: float = 0.5) -> None:
    """Return when this process no longer computes: ``shutdown`` only asks the threads to end."""
    busy = True
    while busy:
        before = time.process_time()
        time.sleep(pause)
        busy = time.process_time() - before > 0.02 * pause


def frames_a_second(sequence: RGBDSequence) -> int:
    """The rate of the camera, after which ORB-SLAM3 makes a keyframe at the latest after a second."""
    return max(round(1 / float(sequence.stamps.diff().median())), 1)


def settings(camera: PinholeCamera, fps: int) -> str:
    """The settings file: the camera's own, the rest as in ORB-SLAM3's example for TUM's sequences.

    Depth is handed over in metres, hence a factor of 1.
    """
    k1, k2, p1, p2, k3 = camera.distortion
    lens = {"k1": k1, "k2": k2, "p1": p1, "p2": p2, "k3": k3} if camera.is_distorted else {}
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
