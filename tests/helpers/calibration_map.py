"""Map of a camera that moves in front of random points, built with a camera that can be wrong."""

from __future__ import annotations

import torch
from torch import Tensor

from helpers.random_numbers import RandomNumbers
from helpers.sparse_maps import no_features
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.mapping.map_tables import MapTables
from v3d_torch.odometry.rolling_shutter import Readout

TRUE = PinholeCamera(520.0, 515.0, 322.0, 243.0, distortion=(0.10, -0.15, 0.001, -0.002, 0.05))
PIXEL_SIGMA, INVERSE_DEPTH_SIGMA = 0.5, 0.003
SWING = torch.tensor([0.5, 0.4, 0.3, 0.25, 0.35, 0.4], dtype=torch.float64)
"""Amplitude of the motion of the camera, metres and radians."""


def make_map(
    given: PinholeCamera,
    true: PinholeCamera = TRUE,
    *,
    keyframes: int = 12,
    points: int = 150,
    noise: float = 1.0,
    swing: Tensor = SWING,
    readout: float = 0.0,
    seed: int = 0,
) -> MapTables:
    """Make a map from exact poses and points and noisy observations.

    Args:
        given: Camera with which the observations are undistorted.
        true: Camera that made the images.
        keyframes: Number of keyframes.
        points: Number of points.
        noise: Factor of the noise.
        swing: Amplitude of the motion, metres and radians, (6,).
        readout: Time from the first row to the last, seconds; the map assumes 0.
        seed: Seed of scene and noise.
    """
    random = RandomNumbers(seed)
    phase = 6.28 * random.uniform(6)
    time = torch.linspace(0, 6.28, keyframes, dtype=torch.float64)[:, None]
    T_cw = se3_exp(swing * torch.sin(time * torch.tensor([1.0, 1.3, 0.7, 1.1, 0.9, 1.5]) + phase))
    uv = random.uniform(points, 2) * torch.tensor([640.0, 480.0])
    world = true.back_project(uv, 1 + 3 * random.uniform(points))
    world = (invert(T_cw[keyframes // 2]) @ torch.cat([world, torch.ones(points, 1).double()], dim=1).T).T[:, :3]
    tables = MapTables()
    tables.readout = Readout(0.0, 1.0)
    tables.landmarks.append(
        point=world + 0.01 * noise * random.normal(points, 3),
        direction=torch.zeros(points, 3).double(),
        reference_distance=torch.ones(points).double(),
        descriptor=torch.zeros(points, 32, dtype=torch.uint8),
        keyframe=torch.zeros(points, dtype=torch.int64),
        found=torch.ones(points, dtype=torch.int64),
        visible=torch.ones(points, dtype=torch.int64),
        active=torch.ones(points, dtype=torch.bool),
    )
    for index in range(keyframes):
        tables.keyframes.append(Keyframe(index, index, float(index), T_cw[index], no_features(), torch.zeros(0).long()))
        in_camera = world @ T_cw[index, :3, :3].T + T_cw[index, :3, 3]
        pixel, visible = true.project_to_image(in_camera, 0.3)
        velocity = 300 * random.normal(1, 2).expand(points, 2)  # pixels per second, the same for all pixels of an image
        jacobian = -(pixel[:, 1:] / 479 - 0.5) * velocity
        measured = pixel - readout * jacobian + noise * PIXEL_SIGMA * random.normal(points, 2)
        offset = given.inverse_depth_offset - true.inverse_depth_offset
        inverse_depth = 1 / in_camera[:, 2] + offset + noise * INVERSE_DEPTH_SIGMA * random.normal(points)
        seen = torch.nonzero(visible)[:, 0]
        tables.observations.append(
            keyframe=torch.full_like(seen, index),
            landmark=seen,
            feature=seen,
            uv=given.undistort(measured[seen]),
            readout_jacobian=jacobian[seen],
            inverse_depth=inverse_depth[seen],
            octave=torch.zeros_like(seen),
            sigma_ratio=torch.ones(len(seen), 2, dtype=torch.float64),
            valid=torch.ones_like(seen, dtype=torch.bool),
        )
    return tables
