"""Kernel of the whitening of measurements; see `v3d_torch.optim.reprojection`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from v3d_torch.kernels.compiler import kernel

Array = NDArray[np.float64]


@kernel("(f8[:,::1], f8[::1], f8[::1], f8[::1], f8[:,::1])")
def whiten(
    uv: Array, inverse_depth: Array, pixel_sigma: Array, inverse_depth_sigma: Array, K: Array
) -> tuple[Array, Array]:  # fmt: skip
    """Scale and offset of the whitened residuals, both (3, M).

    Args:
        uv: Undistorted pixels, (M, 2).
        inverse_depth: Inverse of the measured depth, 1/m, (M,); 0 = not measured.
        pixel_sigma: Standard deviation of u and of v, pixels, (M,).
        inverse_depth_sigma: Standard deviation of inverse depth, 1/m, (M,).
        K: Camera matrix, (3, 3).
    """
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    scale, offset = np.empty((3, len(uv))), np.empty((3, len(uv)))
    for i in range(len(uv)):
        w, sigma, depth_sigma = inverse_depth[i], pixel_sigma[i], inverse_depth_sigma[i]
        # Multiply by the reciprocal, as torch does when it divides a number by a tensor.
        scale[0, i], scale[1, i] = fx * (1 / sigma), fy * (1 / sigma)
        scale[2, i] = (1.0 if w > 0 else 0.0) / depth_sigma
        offset[0, i], offset[1, i] = (cx - uv[i, 0]) / sigma, (cy - uv[i, 1]) / sigma
        offset[2, i] = (w if w > 0 else 0.0) / -depth_sigma
    return scale, offset
