"""Kernel of the compensation of readout times; see `v3d_torch.odometry.time_compensation`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from v3d_torch.kernels.compiler import device, kernel

Array = NDArray[np.float64]
Intrinsics = tuple[float, float, float, float]


@device
def _motion_field(
    u: float, v: float, inverse_depth: float, velocity: Array, intrinsics: Intrinsics
) -> tuple[float, float, float]:
    """Velocity of a pixel and rate of its inverse depth, by the formula of `v3d_torch.geometry.motion_field`."""
    fx, fy, cx, cy = intrinsics
    x, y, w = (u - cx) / fx, (v - cy) / fy, inverse_depth
    vx, vy, vz, wx, wy, wz = velocity[0], velocity[1], velocity[2], velocity[3], velocity[4], velocity[5]
    s = w * vz + wx * y - wy * x
    return (w * vx + wy - wz * y - x * s) * fx, (w * vy + wz * x - wx - y * s) * fy, -s * w


@device
def _inverse(depth: float, min_depth: float) -> float:
    return 1 / max(depth, min_depth) if depth > 0 else 0.0


@kernel("(f8[:,::1], i8[:,::1], f8[::1], f8[:,::1], f4[:,::1], f8[::1], f8, f8, i8, f8, f8, UniTuple(f8, 4))")
def compensate(
    uv: Array, pixel: NDArray[np.int64], depth: Array, readout_jacobian: Array, depth_image: NDArray[np.float32],
    velocity: Array, delay: float, readout: float, rows: int, min_depth: float, max_depth: float, intrinsics: Intrinsics,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Compensate depth delay, then rolling shutter.

    Args:
        uv: Undistorted pixels of the features, (N, 2).
        pixel: (column, row) in the recorded image, (N, 2).
        depth: Depth, metres, (N,); 0 = no measurement.
        readout_jacobian: Derivative of ``uv`` by the readout, pixels per second, (N, 2).
        depth_image: Depth image, metres, (H, W); 0 = no measurement.
        velocity: Twist per second ``[m/s, rad/s]`` by which static points move in the camera frame, (6,).
        delay: Depth stamp minus colour stamp, seconds; 0 = the depth stays.
        readout: Readout, seconds.
        rows: Number of rows that are read in this time.
        min_depth: Keeps the inverse depth finite, metres.
        max_depth: Depth beyond this counts as missing, metres.
        intrinsics: ``fx, fy, cx, cy``.

    Returns:
        New ``uv``, ``depth`` and ``readout_jacobian``.
    """
    height, width = depth_image.shape
    new_uv, new_depth, new_jacobian = np.empty_like(uv), depth.copy(), np.empty_like(uv)
    for i in range(len(uv)):
        if delay != 0:
            du, dv, rate = _motion_field(uv[i, 0], uv[i, 1], _inverse(depth[i], min_depth), velocity, intrinsics)
            column, row, z = np.rint(pixel[i, 0] + delay * du), np.rint(pixel[i, 1] + delay * dv), 0.0
            if 0 <= column < width and 0 <= row < height:
                z = np.float64(depth_image[int(row), int(column)])
            new_depth[i] = z / (1 - delay * rate * z) if 0 < z <= max_depth else 0.0
        u = uv[i, 0] - readout * readout_jacobian[i, 0]
        v = uv[i, 1] - readout * readout_jacobian[i, 1]
        du, dv, _ = _motion_field(u, v, _inverse(new_depth[i], min_depth), velocity, intrinsics)
        time = pixel[i, 1] / (rows - 1) - 0.5  # of the row, in readouts since the middle row
        new_jacobian[i, 0], new_jacobian[i, 1] = -time * du, -time * dv
        new_uv[i, 0], new_uv[i, 1] = u + readout * new_jacobian[i, 0], v + readout * new_jacobian[i, 1]
    return new_uv, new_depth, new_jacobian
