"""Kernels of the free-space check; see `v3d_torch.objects.free_space_check`."""

from __future__ import annotations

import math

import numpy as np

from v3d_torch.kernels.arrays import Floats, Floats32
from v3d_torch.kernels.camera import Bounds, Intrinsics, distort, is_in_image
from v3d_torch.kernels.compiler import device, kernel
from v3d_torch.kernels.reprojection import transform

Limits = tuple[float, float, float, float]
"""Minimum and maximum depth of a point, metres; tolerance divided by the squared depth, 1/m; minimum tolerance, m."""


@device
def _to_pixels(points: Floats, intrinsics: Intrinsics, pixels: Floats) -> None:
    for i in range(points.shape[1]):
        pixels[0, i], pixels[1, i] = distort(points[0, i], points[1, i], intrinsics)


@device
def compare(
    points: Floats, nearest_depth: Floats32, intrinsics: Intrinsics, bounds: Bounds, limits: Limits, free: Floats
) -> None:
    """Compare points (x / z, y / z, z), (3, N), with a view: 1 in free space, 0 on a surface, NaN if unknown, (N,)."""
    min_depth, _, relative_tolerance, min_tolerance = limits
    pixels = np.empty((2, free.size))
    _to_pixels(points, intrinsics, pixels)  # a loop of its own is vectorised
    for i in range(free.size):
        a, b, z = points[0, i], points[1, i], points[2, i]
        u, v = pixels[0, i], pixels[1, i]
        free[i] = math.nan
        if is_in_image(a, b, z, u, v, min_depth, bounds):
            measured = nearest_depth[int(np.rint(v)), int(np.rint(u))]
            tolerance = max(relative_tolerance * (z * z), min_tolerance)
            if measured > 0 and measured > z - tolerance:
                free[i] = 1.0 if measured > z + tolerance else 0.0


@kernel("(f8[:,:], f8[:,::1], f4[:,::1], UniTuple(f8, 13), UniTuple(f8, 6), UniTuple(f8, 4))")
def observe_free_space(
    points: Floats, T_cw: Floats, nearest_depth: Floats32, intrinsics: Intrinsics, bounds: Bounds, limits: Limits
) -> Floats:
    """Return for each point whether a view observes its place as free.

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
    free, in_view = np.empty(len(points)), np.empty((3, len(points)))
    for i in range(len(points)):
        x, y, z = transform(T_cw, points[i, 0], points[i, 1], points[i, 2])
        in_view[0, i], in_view[1, i], in_view[2, i] = x / z, y / z, z
    compare(in_view, nearest_depth, intrinsics, bounds, limits, free)
    return free


@device
def _transform_row(
    depth: Floats32, stride: int, rays: Floats, T_wc: Floats, T_cw: Floats, limits: Limits, in_view: Floats
) -> None:
    """Transform every n-th point of a row from one view to another, (x / z, y / z, z); z is NaN without depth."""
    min_depth, max_depth, _, _ = limits
    for i in range(in_view.shape[1]):
        d = float(depth[i * stride])
        x, y, z = transform(T_wc, rays[0, i] * d, rays[1, i] * d, rays[2, i] * d)
        x, y, z = transform(T_cw, x, y, z)
        in_view[0, i], in_view[1, i] = x / z, y / z
        in_view[2, i] = z if (min_depth < d) & (d <= max_depth) else math.nan


@kernel(
    "(f4[:,::1], i8, f8[:,::1], f8[:,::1], f8[:,::1], f4[:,::1], UniTuple(f8, 13), UniTuple(f8, 6), UniTuple(f8, 4),"
    " f8[:,::1])"
)
def was_free(
    depth: Floats32, stride: int, rays: Floats, T_wc: Floats, T_cw: Floats, nearest_depth: Floats32,
    intrinsics: Intrinsics, bounds: Bounds, limits: Limits, result: Floats,
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
        result: 1 for free space, 0 for a surface, NaN if unknown, (h, w); written.
    """
    height, width = result.shape
    in_view = np.empty((3, width))
    for row in range(height):
        row_rays = rays[:, row * width : (row + 1) * width]
        _transform_row(depth[row * stride], stride, row_rays, T_wc, T_cw, limits, in_view)
        compare(in_view, nearest_depth, intrinsics, bounds, limits, result[row])
