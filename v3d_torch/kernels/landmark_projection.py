"""Kernel of the projection of a local map; see `v3d_torch.features.projection_matcher`."""

from __future__ import annotations

import math

import numpy as np

from v3d_torch.kernels.arrays import Floats, Ints
from v3d_torch.kernels.compiler import kernel
from v3d_torch.kernels.reprojection import transform


@kernel("(f8[:,::1], f8[:,::1], f8[:,::1], f8[::1], f8[:,::1], f8[:,::1], f8, i8, i8)")
def project(
    T_cw: Floats, points: Floats, directions: Floats, reference_distance: Floats, K: Floats, bounds: Floats,
    log_scale: float, first_octave: int, last_octave: int,
) -> tuple[Ints, Floats, Floats, Ints]:  # fmt: skip
    """Project landmarks into a camera, and select the V landmarks in view.

    Args:
        T_cw: World-to-camera pose, (4, 4).
        points: Landmarks, world frame, (L, 3).
        directions: Unit viewing directions of the first observations, world frame, (L, 3).
        reference_distance: Distances at which the landmarks appear at octave 0, metres, (L,).
        K: Camera matrix, (3, 3).
        bounds: Lower (inclusive) and upper bound of (z, u, v, cosine, octave), (2, 5).
        log_scale: Logarithm of the scale factor between octaves.
        first_octave: Octave of the finest pyramid level.
        last_octave: Octave of the coarsest pyramid level.

    Returns:
        Indices of the landmarks in view, (V,), their pixels, (V, 2), depth, metres, (V,), and octaves, (V,).
    """
    lower, upper = bounds
    rows, octaves = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
    uv, depth, count = np.empty((len(points), 2)), np.empty(len(points)), 0
    for i in range(len(points)):
        x, y, z = transform(T_cw, points[i, 0], points[i, 1], points[i, 2])
        u, v = (K[0, 0] * x + K[0, 2] * z) / z, (K[1, 1] * y + K[1, 2] * z) / z
        if not (lower[0] <= z < upper[0] and lower[1] <= u < upper[1] and lower[2] <= v < upper[2]):
            continue
        distance = math.sqrt(x * x + y * y + z * z)
        cosine = 0.0
        for k, coordinate in enumerate((x, y, z)):
            rotated = T_cw[k, 0] * directions[i, 0] + T_cw[k, 1] * directions[i, 1] + T_cw[k, 2] * directions[i, 2]
            cosine += coordinate * rotated
        cosine /= distance
        octave = math.log(reference_distance[i] / distance) / log_scale
        if lower[3] <= cosine < upper[3] and lower[4] <= octave < upper[4]:
            rows[count], uv[count, 0], uv[count, 1], depth[count] = i, u, v, z
            octaves[count] = min(max(int(np.rint(octave)), first_octave), last_octave)
            count += 1
    return rows[:count], uv[:count], depth[:count], octaves[:count]
