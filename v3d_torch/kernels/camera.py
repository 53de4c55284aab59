"""Projection of one point into a camera with lens distortion; see `v3d_torch.geometry.camera.PinholeCamera`."""

from __future__ import annotations

import math

from v3d_torch.kernels.compiler import device

Intrinsics = tuple[float, float, float, float, float, float, float, float, float]
"""``fx, fy, cx, cy, k1, k2, p1, p2, k3``; in signatures ``UniTuple(f8, 9)``."""

Bounds = tuple[float, float, float, float, float, float]
"""Minimum and maximum of x / z and of y / z in the image, width and height; in signatures ``UniTuple(f8, 6)``."""


@device
def distort(x: float, y: float, intrinsics: Intrinsics) -> tuple[float, float]:
    """Return the distorted pixel (u, v) at normalised image coordinates, by the Brown-Conrady model."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = intrinsics
    if k1 != 0 or k2 != 0 or p1 != 0 or p2 != 0 or k3 != 0:
        r2 = x * x + y * y
        factor = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)) + 2 * (x * p2 + y * p1)
        x, y = x * factor + r2 * p2, y * factor + r2 * p1
    return x * fx + cx, y * fy + cy


@device
def project_to_image(
    x: float, y: float, z: float, min_depth: float, intrinsics: Intrinsics, bounds: Bounds
) -> tuple[bool, float, float]:
    """Check whether a point in the camera frame, metres, lies in the image, and return its distorted pixel (u, v).

    The pixel of a point outside the image is NaN.
    """
    x_min, x_max, y_min, y_max, width, height = bounds
    a, b = x / z, y / z
    if z > min_depth and x_min <= a <= x_max and y_min <= b <= y_max:
        u, v = distort(a, b, intrinsics)
        if -0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5:
            return True, u, v
    return False, math.nan, math.nan
