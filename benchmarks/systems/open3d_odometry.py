"""RGB-D odometry of Open3D (Zhou et al., 2018), from each frame to the next, by colour and depth ("hybrid").

It has the defaults of Open3D, which use depth up to 3 m.

Open3D has no complete SLAM system on a CPU, only this odometry.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
import open3d as o3d
import torch
from open3d.t.geometry import Image, RGBDImage
from open3d.t.pipelines.odometry import Method, rgbd_odometry_multi_scale

from v3d_torch.datasets import RGBDSequence
from v3d_torch.types import RGBDFrame, Trajectory


class Open3DOdometry:
    """System with the RGB-D odometry of Open3D.

    Args:
        sequence: Sequence to run on.
    """

    stages: Mapping[str, float] = {}

    def __init__(self, sequence: RGBDSequence) -> None:
        self._sequence = sequence
        camera = sequence.camera
        self._K = o3d.core.Tensor(camera.K.numpy())
        self._lens = None
        if camera.is_distorted:  # Open3D has no lens model
            K, size = camera.K.numpy(), (camera.width, camera.height)
            self._lens = cv2.initUndistortRectifyMap(K, np.array(camera.distortion), None, K, size, cv2.CV_32FC1)
        self._T_wc = [torch.eye(4, dtype=torch.float64)]

    def __call__(self) -> None:
        """Chain the motions between frames. If no motion is found, the camera is assumed to stand still."""
        previous = None
        for frame in self._sequence:
            current = self._convert(frame)
            if previous is not None:
                self._T_wc.append(self._T_wc[-1] @ self._motion(current, previous))
            previous = current

    def trajectory(self) -> Trajectory:
        """Return a pose for every frame."""
        return Trajectory(self._sequence.stamps, torch.stack(self._T_wc))

    def _motion(self, source: RGBDImage, target: RGBDImage) -> torch.Tensor:
        """Return the transform from the source camera to the target camera, with the initial value of Open3D: identity.

        The previous motion as initial value is more accurate for a moving camera, but can diverge for one at rest.
        """
        try:
            result = rgbd_odometry_multi_scale(source, target, self._K, depth_scale=1.0, method=Method.Hybrid)
        except RuntimeError:  # too little depth, or no overlap
            return torch.eye(4, dtype=torch.float64)
        return torch.from_numpy(result.transformation.numpy().copy())

    def _convert(self, frame: RGBDFrame) -> RGBDImage:
        image, depth = frame.image.permute(1, 2, 0).numpy(), frame.depth[0].numpy()
        if self._lens is not None:
            image = cv2.remap(image, *self._lens, cv2.INTER_LINEAR)
            depth = cv2.remap(depth, *self._lens, cv2.INTER_NEAREST)
        return RGBDImage(*(Image(o3d.core.Tensor(np.ascontiguousarray(plane))) for plane in (image, depth)))
