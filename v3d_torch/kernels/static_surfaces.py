"""Kernel of static surfaces; see `v3d_torch.objects.static_surfaces`."""

from __future__ import annotations

import math

import numpy as np

from v3d_torch.kernels.arrays import Bools, Floats, Floats32, Ints
from v3d_torch.kernels.camera import Bounds, Intrinsics
from v3d_torch.kernels.compiler import kernel
from v3d_torch.kernels.free_space import Limits, compare
from v3d_torch.kernels.reprojection import transform


@kernel(
    "(f4[:,::1], i8, f4[:,:,::1], f8[:,::1], f8[:,::1], f4[:,::1], UniTuple(f8, 13), UniTuple(f8, 6), UniTuple(f8, 4),"
    " i8[::1], b1[:,::1])"
)
def find_static(
    depth: Floats32, stride: int, rays: Floats32, T_wc: Floats, T_cw: Floats, nearest_depth: Floats32,
    intrinsics: Intrinsics, bounds: Bounds, limits: Limits, unknown: Ints, static: Bools,
) -> Ints:  # fmt: skip
    """Find the pixels whose surface another view observes.

    Args:
        depth: Depth of the current view, metres, (H, W).
        stride: Step n between the pixels.
        rays: Ray of each pixel at unit depth, (H, W, 3).
        T_wc: Camera-to-world pose of the current view, (4, 4).
        T_cw: World-to-camera pose of the other view, (4, 4).
        nearest_depth: Minimum depth around each pixel of the other view, metres, (H, W).
        intrinsics: Intrinsics of the camera.
        bounds: Extent of the image.
        limits: Range of depths and tolerances.
        unknown: Indices of the pixels to check, among every n-th pixel, (P,).
        static: Every n-th pixel whose surface is observed, (h, w); written.

    Returns:
        Indices of the pixels whose place the view does not observe, (Q,).
    """
    found = static.ravel()
    in_view, free = np.empty((3, len(unknown))), np.empty(len(unknown))
    for i in range(len(unknown)):
        row, column = divmod(unknown[i], static.shape[1])
        v, u = stride * row, stride * column
        d = float(depth[v, u])
        x, y, z = transform(T_wc, rays[v, u, 0] * d, rays[v, u, 1] * d, rays[v, u, 2] * d)
        x, y, z = transform(T_cw, x, y, z)
        in_view[0, i], in_view[1, i], in_view[2, i] = x / z, y / z, z
    compare(in_view, nearest_depth, intrinsics, bounds, limits, free)
    remaining, count = np.empty_like(unknown), 0
    for i in range(len(unknown)):
        if free[i] == 0:
            found[unknown[i]] = True
        elif math.isnan(free[i]):
            remaining[count] = unknown[i]
            count += 1
    return remaining[:count]
