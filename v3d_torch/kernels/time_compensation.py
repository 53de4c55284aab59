"""Kernels of the compensation of readout times; see `v3d_torch.odometry.depth_delay` and `.rolling_shutter`."""

from __future__ import annotations

import numpy as np

from v3d_torch.kernels.arrays import Floats, Floats32, Ints
from v3d_torch.kernels.compiler import device, kernel

PinholeIntrinsics = tuple[float, float, float, float]
"""``fx, fy, cx, cy`` of a camera without lens distortion; in signatures ``UniTuple(f8, 4)``."""


@device
def _motion_field(
    u: float, v: float, inverse_depth: float, velocity: Floats, intrinsics: PinholeIntrinsics
) -> tuple[float, float, float]:
    """Velocity of a pixel and rate of its inverse depth, by the formula of `v3d_torch.geometry.motion_field`."""
    fx, fy, cx, cy = intrinsics
    x, y, w = (u - cx) / fx, (v - cy) / fy, inverse_depth
    vx, vy, vz, wx, wy, wz = velocity[0], velocity[1], velocity[2], velocity[3], velocity[4], velocity[5]
    s = w * vz + wx * y - wy * x
    return (w * vx + wy - wz * y - x * s) * fx, (w * vy + wz * x - wx - y * s) * fy, -s * w


@device
def _depth_at(depth_image: Floats32, column: float, row: float, max_depth: float) -> float:
    """Depth at a pixel with whole coordinates, metres; 0 outside of the image, and above the maximum."""
    height, width = depth_image.shape
    if not (0 <= column < width and 0 <= row < height):
        return 0.0
    z = np.float64(depth_image[int(row), int(column)])
    return z if 0 < z <= max_depth else 0.0


@kernel("(f8[:,::1], i8[:,::1], f4[:,::1], f8[::1], f8, f8, UniTuple(f8, 4))")
def compensate_depth_delay(
    uv: Floats, pixel: Ints, depth_image: Floats32, velocity: Floats,
    delay: float, max_depth: float, intrinsics: PinholeIntrinsics,
) -> Floats:  # fmt: skip
    """Depth of features at the time of the colour image, metres, (N,); 0 = no measurement.

    Args:
        uv: Undistorted pixels of the features, (N, 2).
        pixel: (column, row) in the recorded image, (N, 2).
        depth_image: Depth image, metres, (H, W); 0 = no measurement.
        velocity: Twist ``[m/s, rad/s]`` by which static points move in the camera frame, (6,).
        delay: Time of the depth image minus time of the colour image, seconds.
        max_depth: Depth above this counts as missing, metres.
        intrinsics: ``fx, fy, cx, cy``.
    """
    depth = np.zeros(len(uv))
    for i in range(len(uv)):
        z = _depth_at(depth_image, pixel[i, 0], pixel[i, 1], max_depth)
        du, dv, _ = _motion_field(uv[i, 0], uv[i, 1], 1 / z if z > 0 else 0.0, velocity, intrinsics)
        column, row = np.rint(pixel[i, 0] + delay * du), np.rint(pixel[i, 1] + delay * dv)
        z = _depth_at(depth_image, column, row, max_depth)
        if z > 0:
            _, _, rate = _motion_field(uv[i, 0], uv[i, 1], 1 / z, velocity, intrinsics)
            depth[i] = z / (1 - delay * rate * z)
    return depth


@kernel("(f8[:,::1], f8[::1], f8[::1], f8[::1], f8[:,::1], f8[:,::1], f8, i8)")
def compensate_rolling_shutter(
    uv: Floats, row: Floats, inverse_depth: Floats, velocity: Floats, K: Floats, readout_jacobian: Floats,
    readout: float, rows: int,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Pixels of features at the time of the middle row, and their derivatives with respect to the readout, both (N, 2).

    Args:
        uv: Undistorted pixels, compensated with ``readout_jacobian``, (N, 2).
        row: Row in the recorded image, (N,).
        inverse_depth: Inverse depth, 1/m, (N,); 0 = no measurement.
        velocity: Twist ``[m/s, rad/s]`` by which static points move in the camera frame, (6,).
        K: Camera matrix, (3, 3).
        readout_jacobian: Readout Jacobian with which ``uv`` was compensated, pixels per second, (N, 2); it is replaced.
        readout: Time from the first to the last row, seconds.
        rows: Number of rows of the image.
    """
    intrinsics = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    new_uv, new_jacobian = np.empty_like(uv), np.empty_like(uv)
    for i in range(len(uv)):
        u = uv[i, 0] - readout * readout_jacobian[i, 0]
        v = uv[i, 1] - readout * readout_jacobian[i, 1]
        du, dv, _ = _motion_field(u, v, inverse_depth[i], velocity, intrinsics)
        time = row[i] / (rows - 1) - 0.5  # time of the row, from -0.5 to 0.5 readouts
        new_jacobian[i, 0], new_jacobian[i, 1] = -time * du, -time * dv
        new_uv[i, 0], new_uv[i, 1] = u + readout * new_jacobian[i, 0], v + readout * new_jacobian[i, 1]
    return new_uv, new_jacobian
