"""Kernel of the instance clouds; see `v3d_torch.objects.instance_clouds`."""

from __future__ import annotations

import numpy as np

from v3d_torch.kernels.arrays import Bools, Floats32, Ints
from v3d_torch.kernels.compiler import device, kernel
from v3d_torch.kernels.dbscan import dbscan
from v3d_torch.kernels.voxel import pool_voxels

MIN_PART_SIZE = 0.2
"""Minimum number of points of another part of an object, as a fraction of those of its largest cluster."""

MAX_PART_OFFSET = 0.1
"""Maximum difference between the mean depths of another part of an object and its largest cluster, metres: about half
of the depth of a body."""


@device
def _is_empty(row: Bools) -> bool:
    """Check whether a row of a mask has no pixels; all of them are read, as a loop over vectors."""
    found = False
    for pixel in row:
        found |= pixel
    return not found


@device
def back_project(
    depth: Floats32, mask: Bools, rays: Floats32, stride: int, max_depth: np.float32
) -> tuple[Floats32, Ints]:
    """Back-project every n-th pixel of a mask that has a depth: points, (P, 3), and their rows and columns, (P, 2).

    The arguments are those of `instance_cloud`.
    """
    height, width = depth.shape
    points, pixels, count, ray = np.empty((len(rays), 3), np.float32), np.empty((len(rays), 2), np.int64), 0, 0
    for row in range(0, height, stride):
        if _is_empty(mask[row]):
            ray += -(-width // stride)
            continue
        for column in range(0, width, stride):
            z = depth[row, column]
            if mask[row, column] and z > 0 and z <= max_depth:
                for axis in range(3):
                    points[count, axis] = rays[ray, axis] * z
                pixels[count, 0], pixels[count, 1] = row, column
                count += 1
            ray += 1
    return points[:count], pixels[:count]


@device
def _select_object(labels: Ints, points: Floats32) -> Bools:
    """Mask of the points of the largest cluster and of other parts of the object, shape (N,).

    Of equal clusters, the one with the lower label counts as the largest.
    """
    sizes, depths = np.zeros(len(labels) + 1, np.int64), np.zeros(len(labels) + 1)
    for i, label in enumerate(labels):
        if label >= 0:
            sizes[label] += 1
            depths[label] += points[i, 2]
    largest = sizes.argmax()
    selected = np.zeros(len(labels), np.bool_)
    for i, label in enumerate(labels):
        if label >= 0:
            offset = abs(depths[label] / sizes[label] - depths[largest] / sizes[largest])
            selected[i] = offset <= MAX_PART_OFFSET and sizes[label] >= MIN_PART_SIZE * sizes[largest]
    return selected


@kernel("(f4[:,::1], b1[:,::1], f4[:,::1], i8, f4, f4, f8, i8, b1[:,::1])")
def instance_cloud(
    depth: Floats32, mask: Bools, rays: Floats32, stride: int, max_depth: np.float32, voxel_size: np.float32,
    eps: float, min_samples: int, cloud_pixels: Bools,
) -> tuple[Floats32, Bools]:  # fmt: skip
    """Back-project one instance, pool its points, and select the clusters of the object.

    Args:
        depth: Depth, metres, (H, W); 0 = no measurement.
        mask: Pixels of the instance, (H, W).
        rays: Ray of every n-th pixel, in row-major order, (R, 3).
        stride: Step n between the pixels.
        max_depth: Largest depth of a point, metres.
        voxel_size: Side of a voxel, metres.
        eps: Radius of DBSCAN, metres.
        min_samples: Minimum number of points in the neighbourhood of a core point, itself included.
        cloud_pixels: Pixels of the mask whose point belongs to the object, (H, W), written; false before.

    Returns:
        Mean point of each voxel, metres, (M, 3), and mask of the voxels of the object, (M,).
    """
    height, width = depth.shape
    points, pixels = back_project(depth, mask, rays, stride, max_depth)
    means, _, voxels = pool_voxels(points, voxel_size, np.inf)
    if len(means) == 0:  # also if a point is not finite: it has no voxel
        return means, np.zeros(0, np.bool_)
    selected = _select_object(dbscan(means.astype(np.float64), eps, min_samples), means)
    for i in range(len(points)):
        if selected[voxels[i]]:
            row, column = pixels[i]
            for v in range(row, min(row + stride, height)):
                for u in range(column, min(column + stride, width)):
                    cloud_pixels[v, u] = mask[v, u]
    return means, selected
