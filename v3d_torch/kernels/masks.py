"""Kernels of masks: dilation, and growth over smooth surfaces; see `v3d_torch.objects.dilation` and `.mask_refiner`."""

from __future__ import annotations

import numpy as np

from v3d_torch.kernels.arrays import Bytes, Ints32
from v3d_torch.kernels.compiler import device, kernel


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


@kernel("(u1[:,::1], u1[::1])")
def dilate(mask: Bytes, heights: Bytes) -> Bytes:
    """Dilate a mask by a convex, symmetric shape.

    Args:
        mask: Mask of 0 and 1, (H, W).
        heights: Height of the shape above its centre, in each column from the centre to the right, pixels, (r + 1,)
            with r below 254.

    Returns:
        Dilated mask, (H, W).
    """
    height, width = mask.shape
    radius = len(heights) - 1
    farthest = np.uint8(radius + 1)
    # Distance to the nearest pixel of the mask in the same column.
    distance = np.full((height + 1, width + 2 * radius), farthest, np.uint8)
    for y in range(height):
        above, row = distance[y - 1 if y else height], distance[y]
        _count_on(above[radius : radius + width], mask[y], farthest, row[radius : radius + width])
    for y in range(height - 2, -1, -1):
        below, row = distance[y + 1], distance[y]
        _lower(below[radius : radius + width], row[radius : radius + width])
    dilated = np.zeros((height, width), np.uint8)
    for y in range(height):
        for x in range(2 * radius + 1):
            _add_near(distance[y, x : x + width], heights[abs(x - radius)], dilated[y])
    return dilated


@device
def _intersect(a: Bytes, b: Bytes, both: Bytes) -> None:
    for x in range(both.size):
        both[x] = a[x] & b[x]


@kernel("(i4[:,::1], i8, u1[:,::1], u1[:,::1], i8, f8)")
def fill_components(
    components: Ints32, count: int, seeds: Bytes, reachable: Bytes, stride: int, min_fraction: float
) -> Bytes:
    """Select the reachable pixels of the components with enough seeds, and of their neighbour cells.

    Args:
        components: Index of the component of each cell, (h, w); 0 for cells without a component.
        count: Number of components, including component 0.
        seeds: Seed cells, (h, w).
        reachable: Reachable pixels, (H, W).
        stride: Side of a cell, pixels.
        min_fraction: Minimum fraction of seeds in a component.

    Returns:
        Selected pixels, (H, W).
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
    surface, pixels = np.empty_like(reachable), np.empty(reachable.shape[1], np.uint8)
    for v in range(len(reachable)):
        if v % stride == 0:
            for u in range(len(pixels)):
                pixels[u] = cells[v // stride + 1, u // stride + 1]
        _intersect(pixels, reachable[v], surface[v])
    return surface
