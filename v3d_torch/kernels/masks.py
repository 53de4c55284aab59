"""Kernels of masks: dilation, pixels of an object, growth over surfaces; see `v3d_torch.objects.mask_refiner`."""

from __future__ import annotations

import numpy as np

from v3d_torch.kernels.arrays import Bytes, Floats32, Ints32
from v3d_torch.kernels.compiler import device, kernel

_LOOP_PIXELS = 128
"""Pixels that a loop over bytes takes at once, four vectors of 32; the rest of a row takes as long as several times as
many."""

Box = tuple[int, int, int, int]
"""First and last row (exclusive), first and last column (exclusive); in signatures ``UniTuple(i8, 4)``."""


@device
def _count_on(previous: Bytes, mask: Bytes, farthest: np.uint8, distance: Bytes) -> None:
    for x in range(distance.size):
        farther = np.uint8(previous[x] + np.uint8(1))
        distance[x] = np.uint8(0) if mask[x] else farther if farther < farthest else farthest


@device
def _lower(following: Bytes, distance: Bytes) -> None:
    for x in range(distance.size):
        distance[x] = min(np.uint8(following[x] + np.uint8(1)), distance[x])


@device
def _add_near(distance: Bytes, height: int, dilated: Bytes) -> None:
    for x in range(dilated.size):
        dilated[x] |= np.uint8(distance[x] <= height)


@device
def _measure_distances(mask: Bytes, box: Box, radius: int) -> Bytes:
    """Distance to the nearest pixel of a mask in the same column of a box, and within the box, at most radius + 1.

    The rows and columns are those of the box, with the radius on its left and right, one more row, and columns up to a
    multiple of `_LOOP_PIXELS`.
    """
    top, bottom, left, right = box
    height, width, farthest = bottom - top, right - left, np.uint8(radius + 1)
    distance = np.full((height + 1, -(-width // _LOOP_PIXELS) * _LOOP_PIXELS + 2 * radius), farthest, np.uint8)
    inside = distance[:, radius : radius + width]
    for y in range(height):
        _count_on(inside[y - 1 if y else height], mask[top + y, left:right], farthest, inside[y])
    for y in range(height - 2, -1, -1):
        _lower(inside[y + 1], inside[y])
    return distance


@device
def _dilate_row(distance: Bytes, heights: Bytes, dilated: Bytes) -> None:
    """Write the dilated pixels of a row from the distances in its columns."""
    radius = heights.size - 1
    dilated[:] = np.uint8(0)
    for x in range(2 * radius + 1):
        _add_near(distance[x : x + dilated.size], heights[abs(x - radius)], dilated)


@device
def _copy(pixels: Bytes, copied: Bytes) -> None:
    for x in range(copied.size):
        copied[x] = pixels[x]


@kernel("(u1[:,::1], UniTuple(i8, 4), u1[::1])")
def dilate(mask: Bytes, box: Box, heights: Bytes) -> Bytes:
    """Dilate the part of a mask in a box by a convex, symmetric shape.

    Args:
        mask: Mask of 0 and 1, (H, W).
        box: Rows and columns of the box.
        heights: Height of the shape above its centre, in each column from the centre to the right, pixels, (r + 1,)
            with r below 254.

    Returns:
        Dilated mask, (H, W); 0 outside the box.
    """
    top, bottom, left, right = box
    radius = len(heights) - 1
    distance = _measure_distances(mask, box, radius)
    dilated, row = np.zeros_like(mask), np.empty(distance.shape[1] - 2 * radius, np.uint8)
    for y in range(top, bottom):
        _dilate_row(distance[y - top], heights, row)
        _copy(row, dilated[y, left:right])
    return dilated


@device
def _select_near(
    agreeing: Bytes, near: Bytes, depth: Floats32, mask: Bytes, on_object: Bytes, static: Bytes, selected: Bytes
) -> None:
    for x in range(selected.size):
        agrees = agreeing[x] | np.uint8(depth[x] <= 0)
        may_belong = mask[x] | (static[x] ^ np.uint8(1))
        selected[x] = (near[x] & agrees & may_belong) | on_object[x]


@device
def _upsample_row(cells: Bytes, stride: int, pixels: Bytes) -> None:
    """Write the value of the cell of each pixel of a row."""
    for column in range(cells.size):
        for u in range(column * stride, min((column + 1) * stride, pixels.size)):
            pixels[u] = cells[column]


@kernel("(u1[:,::1], f4[:,::1], u1[:,::1], u1[:,::1], UniTuple(i8, 4), u1[:,:], i8, u1[::1])")
def select_agreeing(
    agreeing: Bytes, depth: Floats32, mask: Bytes, on_object: Bytes, box: Box, static: Bytes, stride: int,
    heights: Bytes,
) -> Bytes:  # fmt: skip
    """Select the pixels near the mask of an object that agree with the object or have no depth.

    Args:
        agreeing: Pixels of a box whose depth agrees with the object's points, (h, w).
        depth: Depth, metres, (H, W); 0 = no measurement.
        mask: Network's mask of the object, (H, W).
        on_object: Pixels of the object's points, (H, W); they are always selected.
        box: Rows and columns of the box.
        static: Cells of the box that show static surfaces, at least (ceil(h / n), ceil(w / n)); only the mask is
            selected there.
        stride: Side n of a cell, pixels.
        heights: Height of the shape by which the mask is dilated, see `dilate`.

    Returns:
        Selected pixels of the box, (h, w).
    """
    top, bottom, left, right = box
    radius = len(heights) - 1
    distance, selected = _measure_distances(mask, box, radius), np.empty_like(agreeing)
    is_static, near = np.empty(right - left, np.uint8), np.empty(distance.shape[1] - 2 * radius, np.uint8)
    for y in range(bottom - top):
        if y % stride == 0:
            _upsample_row(static[y // stride], stride, is_static)
        own, of_points = mask[top + y, left:right], on_object[top + y, left:right]
        _dilate_row(distance[y], heights, near)
        _select_near(agreeing[y], near, depth[top + y, left:right], own, of_points, is_static, selected[y])
    return selected


@device
def _intersect(a: Bytes, b: Bytes, both: Bytes) -> None:
    for x in range(both.size):
        both[x] = a[x] & b[x]


@kernel("(i4[:,::1], i8, u1[:,:], u1[:,::1], i8, i8, i8, f8, u1[:,::1])")
def fill_components(
    components: Ints32, count: int, seeds: Bytes, reachable: Bytes, top: int, left: int, stride: int,
    min_fraction: float, surface: Bytes,
) -> None:  # fmt: skip
    """Select the reachable pixels of the components with enough seeds, and of their neighbour cells.

    Args:
        components: Index of the component of each cell in a part of the image, (h, w); 0 for cells without a component.
        count: Number of components, including component 0.
        seeds: Seed cells there, (h, w).
        reachable: Reachable pixels, (H, W).
        top: Row of the image at which the part begins.
        left: Column of the image at which the part begins.
        stride: Side of a cell, pixels.
        min_fraction: Minimum fraction of seeds in a component.
        surface: Selected pixels, (H, W); written in the part.
    """
    height, width = components.shape
    sizes, seeded = np.zeros(count, np.int64), np.zeros(count, np.int64)
    for y in range(height):
        for x in range(width):
            sizes[components[y, x]] += 1
            seeded[components[y, x]] += seeds[y, x]
    selected = seeded >= min_fraction * sizes
    selected[0] = False
    cells = np.zeros((height + 2, width + 2), np.uint8)
    for y in range(height):
        for x in range(width):
            if selected[components[y, x]]:
                cells[y + 1, x] = cells[y + 1, x + 1] = cells[y + 1, x + 2] = cells[y, x + 1] = cells[y + 2, x + 1] = 1
    bottom, right = min(top + height * stride, len(reachable)), min(left + width * stride, reachable.shape[1])
    pixels = np.empty(right - left, np.uint8)
    for v in range(top, bottom):
        if (v - top) % stride == 0:
            _upsample_row(cells[(v - top) // stride + 1, 1 : width + 1], stride, pixels)
        _intersect(pixels, reachable[v, left:right], surface[v, left:right])
