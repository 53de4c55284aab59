"""Projection of one point into a camera with lens distortion; see `v3d_torch.geometry.camera.PinholeCamera`."""

from __future__ import annotations

import math

from v3d_torch.kernels.compiler import device

Intrinsics = tuple[float, float, float, float, float, float, float, float, float, float, float, float, float]
"""``fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, equidistant``; in signatures ``UniTuple(f8, 13)``. The last number
is 1 for the fisheye model with k1 to k4, else 0."""

Bounds = tuple[float, float, float, float, float, float]
"""Minimum and maximum of x / z and of y / z in the image, width and height; in signatures ``UniTuple(f8, 6)``."""


MIN_RADIUS = 1e-9
"""Minimum distance from the optical axis, normalised image coordinates: it keeps directions on the axis finite."""


@device
def distort(x: float, y: float, intrinsics: Intrinsics) -> tuple[float, float]:
    """Return the distorted pixel (u, v) at normalised image coordinates; see `v3d_torch.geometry.distortion`."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, equidistant = intrinsics
    r2 = x * x + y * y
    if equidistant != 0:
        r = max(math.sqrt(r2), MIN_RADIUS)
        theta = math.atan(r)
        t2 = theta * theta
        factor = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) / r
        x, y = x * factor, y * factor
    elif k1 != 0 or k2 != 0 or p1 != 0 or p2 != 0 or k3 != 0 or k4 != 0 or k5 != 0 or k6 != 0:
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        if k4 != 0 or k5 != 0 or k6 != 0:
            radial /= 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        factor = radial + 2 * (x * p2 + y * p1)
        x, y = x * factor + r2 * p2, y * factor + r2 * p1
    return x * fx + cx, y * fy + cy


@device
def is_in_image(a: float, b: float, z: float, u: float, v: float, min_depth: float, bounds: Bounds) -> bool:
    """Check whether a point (a, b) = (x / z, y / z) at depth z, with the distorted pixel (u, v), lies in the image."""
    x_min, x_max, y_min, y_max, width, height = bounds
    # Operators without branches, so that a loop over many points becomes a loop over vectors.
    in_view = (z > min_depth) & (a >= x_min) & (a <= x_max) & (b >= y_min) & (b <= y_max)
    return in_view & (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)


@device
def project_to_image(
    x: float, y: float, z: float, min_depth: float, intrinsics: Intrinsics, bounds: Bounds
) -> tuple[bool, float, float]:
    """Check whether a point (camera frame, metres) lies in the image, and return its distorted pixel (u, v).

    The pixel of a point outside the image is NaN.
    """
    a, b = x / z, y / z
    u, v = distort(a, b, intrinsics)
    return (True, u, v) if is_in_image(a, b, z, u, v, min_depth, bounds) else (False, math.nan, math.nan)
