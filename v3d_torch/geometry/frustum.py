"""Viewing frustum of a camera."""

from __future__ import annotations

from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera


def are_in_frustum(centres: Tensor, radii: Tensor | float, camera: PinholeCamera) -> Tensor:
    """Check which spheres can be in the image; those without any point in it can pass, but none with one is missed.

    Args:
        centres: Centres, camera frame, metres, float64, shape :math:`(N, 3)`.
        radii: Radii, metres, a number or shape :math:`(N,)`.
        camera: Camera of the image.

    Returns:
        Bool, shape :math:`(N,)`.
    """
    x, y, z = centres.unbind(dim=1)
    x_min, x_max, y_min, y_max, _, _ = camera.bounds
    inside = z > -radii
    for across, lowest, highest in ((x, x_min, x_max), (y, y_min, y_max)):
        # Distance from each side plane, times the length of its normal (1, slope).
        for slope, distance in ((lowest, across - lowest * z), (highest, highest * z - across)):
            inside &= distance >= -radii * (1 + slope**2) ** 0.5
    return inside
