"""Kernel of ray casting through the occupancy map; see `v3d_torch.occupancy.ray_casting`."""

from __future__ import annotations

import math

import numpy as np

from v3d_torch.kernels.arrays import Bools, Bytes, Floats, Floats32, Ints, Ints32
from v3d_torch.kernels.compiler import device, kernel
from v3d_torch.kernels.voxel_blocks import BITS, FREE, HIT, VOLUME, local_index


@device
def _nearest_depth(depth: Floats32, row: int, column: int) -> float:
    """Minimum depth of a sample and its eight neighbours, metres; samples without depth do not count."""
    height, width = depth.shape
    nearest = math.inf
    for v in range(max(row - 1, 0), min(row + 2, height)):
        for u in range(max(column - 1, 0), min(column + 2, width)):
            if depth[v, u] > 0:
                nearest = min(nearest, float(depth[v, u]))
    return nearest


@device
def _enter(origin: float, direction: float) -> tuple[int, int, float, float]:
    """Traversal of a ray along one axis: first voxel, step, depth at which the ray leaves the voxel, depth per step."""
    voxel = math.floor(origin)
    if direction > 0:
        return voxel, 1, (voxel + 1 - origin) / direction, 1 / direction
    if direction < 0:
        return voxel, -1, (voxel - origin) / direction, -1 / direction
    return voxel, 0, math.inf, math.inf


@device
def _block_row(x: int, y: int, z: int, first: Ints, table: Ints32, blocks: Ints, count: int) -> tuple[int, int]:
    """Row of the block that contains a voxel, and number of rows; a new block gets the row ``count``."""
    x, y, z = x >> BITS, y >> BITS, z >> BITS
    i, j, k = x - first[0], y - first[1], z - first[2]
    row = table[i, j, k]
    if row >= 0:
        return row, count
    table[i, j, k] = count
    blocks[count, 0], blocks[count, 1], blocks[count, 2] = x, y, z
    return count, count + 1


@device
def _cast_ray(
    origin: Floats, direction: Floats, free_depth: float, hit_depth: float, first: Ints, table: Ints32, blocks: Ints,
    marks: Bytes, count: int,
) -> int:  # fmt: skip
    """Mark the voxels along a ray as free, and the voxel of the surface as hit; return the number of blocks."""
    x, step_x, exit_x, depth_x = _enter(origin[0], direction[0])
    y, step_y, exit_y, depth_y = _enter(origin[1], direction[1])
    z, step_z, exit_z, depth_z = _enter(origin[2], direction[2])
    row = -1
    while min(exit_x, exit_y, exit_z) <= free_depth:  # Amanatides and Woo, 1987
        if row < 0:
            row, count = _block_row(x, y, z, first, table, blocks, count)
        voxel = local_index(x, y, z)
        marks[row, voxel] = max(marks[row, voxel], FREE)
        if exit_x <= exit_y and exit_x <= exit_z:
            row = row if x >> BITS == (x + step_x) >> BITS else -1
            x, exit_x = x + step_x, exit_x + depth_x
        elif exit_y <= exit_z:
            row = row if y >> BITS == (y + step_y) >> BITS else -1
            y, exit_y = y + step_y, exit_y + depth_y
        else:
            row = row if z >> BITS == (z + step_z) >> BITS else -1
            z, exit_z = z + step_z, exit_z + depth_z
    if hit_depth > 0:  # otherwise the surface is not static or too far away
        x = math.floor(origin[0] + direction[0] * hit_depth)
        y = math.floor(origin[1] + direction[1] * hit_depth)
        z = math.floor(origin[2] + direction[2] * hit_depth)
        row, count = _block_row(x, y, z, first, table, blocks, count)
        marks[row, local_index(x, y, z)] = HIT
    return count


@kernel("(f4[:,::1], b1[:,::1], f4[:,:,::1], f8[:,::1], f8, f8, f8, i8)")
def observe_voxels(
    depth: Floats32, static: Bools, rays: Floats32, T_wc: Floats, voxel_size: float, max_depth: float,
    tolerance: float, reach: int,
) -> tuple[Ints, Bytes]:  # fmt: skip
    """Find the voxels that a view observes as free or hits.

    Args:
        depth: Depth of the samples, metres, (h, w); 0, NaN or infinite without depth.
        static: Mask of the samples on static surfaces, (h, w); the others hit nothing.
        rays: Ray of each sample at unit depth, camera frame, (h, w, 3).
        T_wc: Camera-to-world pose, (4, 4).
        voxel_size: Side of a voxel, metres.
        max_depth: Depth beyond which nothing is observed, metres.
        tolerance: Depth error divided by the squared depth, 1/m.
        reach: Upper bound of the distance between the block of the camera and the block of any sample, blocks.

    Returns:
        Coordinates of the blocks with observed voxels, (B, 3), in order of their first observation; observation of each
        of their voxels, (B, 4096).
    """
    height, width = depth.shape
    origin, direction, first = T_wc[:3, 3] / voxel_size, np.empty(3), np.empty(3, np.int64)
    for axis in range(3):
        first[axis] = (np.int64(math.floor(origin[axis])) >> BITS) - reach
    side = 2 * reach + 1
    table = np.full((side, side, side), -1, np.int32)
    blocks, marks, count = np.empty((6 * side, 3), np.int64), np.zeros((6 * side, VOLUME), np.uint8), 0
    for row in range(height):
        for column in range(width):
            z = float(depth[row, column])
            if not 0 < z < math.inf:
                continue
            a, b, c = float(rays[row, column, 0]), float(rays[row, column, 1]), float(rays[row, column, 2])
            for axis in range(3):
                direction[axis] = (T_wc[axis, 0] * a + T_wc[axis, 1] * b + T_wc[axis, 2] * c) / voxel_size
            nearest = _nearest_depth(depth, row, column)
            free_depth = min(nearest - (voxel_size / 2 + tolerance * (nearest * nearest)), max_depth)
            if count + 3 * side > len(blocks):  # a ray passes fewer blocks
                blocks = np.concatenate((blocks, np.empty_like(blocks)))
                marks = np.concatenate((marks, np.zeros_like(marks)))
            hit_depth = z if static[row, column] and z <= max_depth else 0.0
            count = _cast_ray(origin, direction, free_depth, hit_depth, first, table, blocks, marks, count)
    return blocks[:count], marks[:count]
