"""Kernels of the occupancy map; see `v3d_torch.occupancy.ray_casting` and `v3d_torch.occupancy.voxel_blocks`."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from v3d_torch.kernels.compiler import device, kernel
from v3d_torch.kernels.reprojection import Array

BITS = 4
"""Binary logarithm of `SIDE`."""

SIDE = 1 << BITS
"""Voxels along a side of a block."""

VOLUME = SIDE**3
"""Voxels in a block."""

FREE, HIT = 1, 2
"""Observations of a voxel in one view; 0 if it was not observed."""

UNKNOWN = -128
"""Log-odds of voxels that were never observed, different from those of all other voxels."""

Depth = NDArray[np.float32]
Ints = NDArray[np.int64]
Marks = NDArray[np.uint8]
Table = NDArray[np.int32]


@device
def _nearest_depth(depth: Depth, row: int, column: int) -> float:
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
def _local_index(x: int, y: int, z: int) -> int:
    """Index of a voxel in its block, with z varying fastest."""
    return (((x & (SIDE - 1)) << BITS | (y & (SIDE - 1))) << BITS) | (z & (SIDE - 1))


@device
def _block_row(x: int, y: int, z: int, first: Ints, table: Table, blocks: Ints, count: int) -> tuple[int, int]:
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
    origin: Array, direction: Array, free_depth: float, hit_depth: float, first: Ints, table: Table, blocks: Ints,
    marks: Marks, count: int,
) -> int:  # fmt: skip
    """Mark the voxels along a ray as free, and the voxel of the surface as hit; return the number of blocks."""
    x, step_x, exit_x, depth_x = _enter(origin[0], direction[0])
    y, step_y, exit_y, depth_y = _enter(origin[1], direction[1])
    z, step_z, exit_z, depth_z = _enter(origin[2], direction[2])
    row = -1
    while min(exit_x, exit_y, exit_z) <= free_depth:  # Amanatides and Woo, 1987
        if row < 0:
            row, count = _block_row(x, y, z, first, table, blocks, count)
        voxel = _local_index(x, y, z)
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
        marks[row, _local_index(x, y, z)] = HIT
    return count


@kernel("(f4[:,::1], b1[:,::1], f4[:,:,::1], f8[:,::1], f8, f8, f8, i8)")
def observe_voxels(
    depth: Depth, static: NDArray[np.bool_], rays: Depth, T_wc: Array, voxel_size: float, max_depth: float,
    tolerance: float, reach: int,
) -> tuple[Ints, Marks]:  # fmt: skip
    """Find the voxels that a view observes as free or hits.

    Args:
        depth: Depth of the samples, metres, (h, w); 0 without depth.
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
            if z <= 0:
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


@kernel("(i1[:,::1], i8[::1], u1[:,::1], i8, i8, i8, i8)")
def add_observations(
    log_odds: NDArray[np.int8], slots: Ints, marks: Marks, hit: int, miss: int, minimum: int, maximum: int
) -> None:
    """Add the observations of one view to the log-odds of blocks.

    Args:
        log_odds: Log-odds of all blocks, steps, (N, 4096); changed in place.
        slots: Row of each observed block, (B,).
        marks: Observations, (B, 4096).
        hit: Log-odds added to a voxel that was hit, steps.
        miss: Log-odds added to a voxel that was observed as free, steps.
        minimum: Smallest log-odds, steps.
        maximum: Largest log-odds, steps.
    """
    for i in range(len(slots)):
        row = log_odds[slots[i]]
        for voxel in range(VOLUME):
            mark = marks[i, voxel]
            if mark:
                before = 0 if row[voxel] == UNKNOWN else np.int64(row[voxel])
                after = before + (hit if mark == HIT else miss)
                row[voxel] = np.int8(min(max(after, minimum), maximum))


@device
def _find_block(x: int, y: int, z: int, keys: Ints, bound: int) -> int:
    """Place of the key of a block among ascending keys; -1 if it is not there."""
    if max(x, y, z) >= bound or min(x, y, z) < -bound:
        return -1
    key = ((x + bound) * 2 * bound + y + bound) * 2 * bound + z + bound
    place = int(np.searchsorted(keys, key))
    return place if place < len(keys) and keys[place] == key else -1


@device
def _squared_gap(point: float, voxel: int, size: float) -> float:
    """Squared distance along one axis between a coordinate and a voxel; 0 inside."""
    low = voxel * size
    gap = max(low - point, point - (low + size), 0.0)
    return gap * gap


@device
def _is_ball_free(
    point: Array, radius: float, size: float, keys: Ints, rows: Ints, bound: int, log_odds: NDArray[np.int8]
) -> bool:
    """Check whether all voxels that a ball touches are free."""
    reach = math.ceil(radius / size)
    i, j, k = math.floor(point[0] / size), math.floor(point[1] / size), math.floor(point[2] / size)
    for x in range(i - reach, i + reach + 1):
        gap_x = _squared_gap(point[0], x, size)
        for y in range(j - reach, j + reach + 1):
            gap_y = _squared_gap(point[1], y, size)
            place, block_z = -1, 0
            for z in range(k - reach, k + reach + 1):
                if math.sqrt(gap_x + gap_y + _squared_gap(point[2], z, size)) > radius:
                    continue
                if place < 0 or z >> BITS != block_z:
                    block_z = z >> BITS
                    place = _find_block(x >> BITS, y >> BITS, block_z, keys, bound)
                if place < 0:
                    return False
                value = log_odds[rows[place], _local_index(x, y, z)]
                if value >= 0 or value == UNKNOWN:
                    return False
    return True


@kernel("(f8[:,::1], f8, f8, i8[::1], i8[::1], i8, i1[:,::1])")
def are_balls_free(
    points: Array, radius: float, size: float, keys: Ints, rows: Ints, bound: int, log_odds: NDArray[np.int8]
) -> NDArray[np.bool_]:
    """Check whether balls lie in free space.

    Args:
        points: Centres of the balls, metres, (P, 3).
        radius: Radius of the balls, metres.
        size: Side of a voxel, metres.
        keys: Keys of the blocks, ascending, (N,).
        rows: Row of each key's block, (N,).
        bound: Bound of the coordinates of blocks.
        log_odds: Log-odds of the blocks, steps, (N, 4096).

    Returns:
        True if all voxels that the ball touches are free, (P,).
    """
    free = np.empty(len(points), np.bool_)
    for i in range(len(points)):
        free[i] = _is_ball_free(points[i], radius, size, keys, rows, bound, log_odds)
    return free
