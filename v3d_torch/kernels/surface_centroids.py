"""Kernel of the surface centroids; see `v3d_torch.objects.surface_centroids`."""

from __future__ import annotations

import numpy as np

from v3d_torch.kernels.arrays import Bools, Floats, Floats32
from v3d_torch.kernels.compiler import kernel
from v3d_torch.kernels.instance_clouds import back_project
from v3d_torch.kernels.voxel import pool_voxels

VOXEL_SIZE = 0.05
"""Side of the voxels over which a centroid averages, metres. They are larger than the distances between the points, so
that near and far parts of a surface count the same."""

MAX_DEPTH_OFFSET = 0.6
"""Pixels whose depth differs more from the median of their mask do not show the object, metres: about the length of an
arm."""


@kernel("(f4[:,::1], b1[:,::1], f4[:,::1], i8, f4)")
def surface_mean(
    depth: Floats32, mask: Bools, rays: Floats32, stride: int, max_depth: np.float32
) -> tuple[Floats, int]:
    """Mean of the voxels of the surface in one mask.

    Args:
        depth: Depth, metres, (H, W); 0 = no measurement.
        mask: Pixels of the surface, (H, W).
        rays: Ray of every n-th pixel at unit depth, in row-major order, (R, 3).
        stride: Step n between the pixels.
        max_depth: Largest depth of a point, metres.

    Returns:
        Mean, camera frame, metres, (3,), and number of pixels with depth. The mean is NaN without such pixels, and if a
        point is not finite.
    """
    points, _ = back_project(depth, mask, rays, stride, max_depth)
    mean, count = np.full(3, np.nan), len(points)
    if count == 0:
        return mean, count
    median = np.partition(points[:, 2], count // 2)[count // 2]
    near = np.abs(points[:, 2] - median) < np.float32(MAX_DEPTH_OFFSET)
    voxels, _, _ = pool_voxels(points[near], np.float32(VOXEL_SIZE), np.inf)
    if len(voxels) > 0:
        for axis in range(3):
            total = 0.0
            for k in range(len(voxels)):
                total += voxels[k, axis]
            mean[axis] = total / len(voxels)
    return mean, count
