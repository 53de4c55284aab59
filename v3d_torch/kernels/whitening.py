"""Kernel of the whitening of measurements; see `v3d_torch.optim.reprojection`."""

from __future__ import annotations

import numpy as np

from v3d_torch.kernels.arrays import Floats
from v3d_torch.kernels.compiler import kernel


@kernel("(f8[:,:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,:,::1])")
def whiten(
    uv: Floats, inverse_depth: Floats, pixel_sigma: Floats, inverse_depth_sigma: Floats, K: Floats
) -> tuple[Floats, Floats]:  # fmt: skip
    """Scale and offset of the whitened residuals of B batches of M measurements, both (B, 3, M).

    Args:
        uv: Undistorted pixels, (B, M, 2).
        inverse_depth: Inverse of the measured depth, 1/m, (B, M); 0 = not measured.
        pixel_sigma: Standard deviation of u and of v, pixels, (B, M).
        inverse_depth_sigma: Standard deviation of inverse depth, 1/m, (B, M).
        K: Camera matrices, (B, 3, 3).
    """
    B, M = inverse_depth.shape
    scale, offset = np.empty((B, 3, M)), np.empty((B, 3, M))
    for b in range(B):
        fx, fy, cx, cy = K[b, 0, 0], K[b, 1, 1], K[b, 0, 2], K[b, 1, 2]
        for i in range(M):
            w, sigma, depth_sigma = inverse_depth[b, i], pixel_sigma[b, i], inverse_depth_sigma[b, i]
            # Multiply by the reciprocal, as torch does when it divides a number by a tensor.
            scale[b, 0, i], scale[b, 1, i] = fx * (1 / sigma), fy * (1 / sigma)
            scale[b, 2, i] = (1.0 if w > 0 else 0.0) / depth_sigma
            offset[b, 0, i], offset[b, 1, i] = (cx - uv[b, i, 0]) / sigma, (cy - uv[b, i, 1]) / sigma
            offset[b, 2, i] = (w if w > 0 else 0.0) / -depth_sigma
    return scale, offset
