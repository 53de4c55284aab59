"""Kernel of static surfaces; see `v3d_torch.objects.static_surfaces`."""

from __future__ import annotations

import numpy as np

from v3d_torch.kernels.arrays import Floats, Floats32
from v3d_torch.kernels.camera import Bounds, Intrinsics
from v3d_torch.kernels.compiler import kernel
from v3d_torch.kernels.free_space import Limits, compare
from v3d_torch.kernels.reprojection import transform


@kernel(
    "(f4[:,::1], i8, f4[:,:,::1], f8[:,::1], f8[:,::1], f4[:,::1], UniTuple(f8, 13), UniTuple(f8, 6), UniTuple(f8, 4),"
    " f8[:,::1])"
)
def observe_unknown(
    depth: Floats32, stride: int, rays: Floats32, T_wc: Floats, T_cw: Floats, nearest_depth: Floats32,
    intrinsics: Intrinsics, bounds: Bounds, limits: Limits, free: Floats,
) -> None:  # fmt: skip
    """Check whether a view observes the places of the pixels that are not known from other views as free.

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
        free: 1 for free space, 0 for a surface, NaN if unknown, for every n-th pixel, (h, w); written where unknown.
    """
    rows, columns = np.nonzero(np.isnan(free))
    in_view, observed = np.empty((3, len(rows))), np.empty(len(rows))
    for i in range(len(rows)):
        v, u = stride * rows[i], stride * columns[i]
        d = float(depth[v, u])
        x, y, z = transform(T_wc, rays[v, u, 0] * d, rays[v, u, 1] * d, rays[v, u, 2] * d)
        x, y, z = transform(T_cw, x, y, z)
        in_view[0, i], in_view[1, i], in_view[2, i] = x / z, y / z, z
    compare(in_view, nearest_depth, intrinsics, bounds, limits, observed)
    for i in range(len(rows)):
        free[rows[i], columns[i]] = observed[i]
