"""Check of the lens model: pixels that it maps no ray to.

The polynomial of a lens that was calibrated without the corners of the image can fold back: from some angle on, a ray
farther from the axis is nearer to the centre of the image. No ray then reaches the corners, and the rays that undistort
their pixels are those of other pixels.
"""

from __future__ import annotations

import torch

from v3d_torch.geometry.camera import PinholeCamera

_MAX_ERROR = 1.0
"""Distance from which a pixel is not that of its ray, pixels: the inverse of a lens model is exact to a thousandth."""

_MIN_FRACTION = 1e-3
"""Minimum fraction of such pixels, for a warning."""


def check_lens(camera: PinholeCamera) -> list[str]:
    """Check whether the rays of the pixels are mapped to these pixels.

    Returns:
        A list with one sentence that states the likely cause, or an empty list.
    """
    if not camera.is_distorted:
        return []
    v, u = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    pixels = torch.stack([u, v], dim=-1).reshape(-1, 2)
    rays = camera.rays.reshape(-1, 3).to(torch.float64)
    error = (camera.distort(camera.project(rays)) - pixels).norm(dim=1)
    fraction = float((error > _MAX_ERROR).to(torch.float64).mean())
    if fraction < _MIN_FRACTION:
        return []
    return [
        f"the {camera.distortion_model} lens model of the camera maps no ray to {fraction:.1%} of the pixels, whose"
        f" points are wrong by up to {float(error.max()):.0f} pixels; correct the distortion of the camera, or crop the"
        " images"
    ]
