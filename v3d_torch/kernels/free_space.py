"""Kernels of the free-space check; see `v3d_torch.objects.free_space_check`."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from v3d_torch.kernels.camera import Bounds, Intrinsics, project_to_image
from v3d_torch.kernels.compiler import device, kernel
from v3d_torch.kernels.reprojection import Array, transform

Depth = NDArray[np.float32]

Limits = tuple[float, float, float, float]
"""Minimum and maximum depth of a point, metres; tolerance divided by the squared depth, 1/m; minimum tolerance, m."""


@device
def _is_free(
    x: float, y: float, z: float, T_cw: Array, nearest_depth: Depth, intrinsics: Intrinsics, bounds: Bounds,
    limits: Limits,
) -> float:  # fmt: skip
    """Return 1 if a point (world frame) lies in free space, 0 if it lies on a surface, NaN if this is unknown."""
    min_depth, _, relative_tolerance, min_tolerance = limits
    x, y, z = transform(T_cw, x, y, z)
    inside, u, v = project_to_image(x, y, z, min_depth, intrinsics, bounds)
    if not inside:
        return math.nan
    measured = nearest_depth[int(np.rint(v)), int(np.rint(u))]
    tolerance = max(relative_tolerance * (z * z), min_tolerance)
    if not (measured > 0 and measured > z - tolerance):
        return math.nan
    return 1.0 if measured > z + tolerance else 0.0


@kernel("(f8[:,:], f8[:,::1], f4[:,::1], UniTuple(f8, 13), UniTuple(f8, 6), UniTuple(f8, 4))")
def is_free_space(
    points: Array, T_cw: Array, nearest_depth: Depth, intrinsics: Intrinsics, bounds: Bounds, limits: Limits
) -> Array:
    """Check whether points lie in space that a view observes as free.

    Args:
        points: Points, world frame, metres, (P, 3), in any memory order.
        T_cw: World-to-camera pose of the view, (4, 4).
        nearest_depth: Minimum depth around each pixel, metres, (H, W); 0 for a pixel without depth.
        intrinsics: Intrinsics of the camera.
        bounds: Extent of the image.
        limits: Range of depths and tolerances.

    Returns:
        1 for free space, 0 for a surface, NaN if unknown, (P,).
    """
    free = np.empty(len(points))
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        free[i] = _is_free(x, y, z, T_cw, nearest_depth, intrinsics, bounds, limits)
    return free


@kernel(
    "(f4[:,::1], i8, f8[:,::1], f8[:,::1], f8[:,::1], f4[:,::1], UniTuple(f8, 13), UniTuple(f8, 6), UniTuple(f8, 4),"
    " f8[:,::1])"
)
def newly_occupied(
    depth: Depth, stride: int, rays: Array, T_wc: Array, T_cw: Array, nearest_depth: Depth, intrinsics: Intrinsics,
    bounds: Bounds, limits: Limits, appeared: Array,
) -> None:  # fmt: skip
    """Check whether the points of every n-th pixel lie in space that an earlier view observed as free.

    Args:
        depth: Depth of the current view, metres, (H, W).
        stride: Step n between the pixels.
        rays: Ray of every n-th pixel at unit depth, (3, h * w).
        T_wc: Camera-to-world pose of the current view, (4, 4).
        T_cw: World-to-camera pose of the earlier view, (4, 4).
        nearest_depth: Minimum depth around each pixel of the earlier view, metres, (H, W).
        intrinsics: Intrinsics of the camera.
        bounds: Extent of the image.
        limits: Range of depths and tolerances.
        appeared: 1 for free space, 0 for a surface, NaN if unknown, (h, w); written.
    """
    min_depth, max_depth, _, _ = limits
    height, width = appeared.shape
    for row in range(height):
        for column in range(width):
            d, i = float(depth[row * stride, column * stride]), row * width + column
            appeared[row, column] = math.nan
            if min_depth < d <= max_depth:
                x, y, z = transform(T_wc, rays[0, i] * d, rays[1, i] * d, rays[2, i] * d)
                appeared[row, column] = _is_free(x, y, z, T_cw, nearest_depth, intrinsics, bounds, limits)
