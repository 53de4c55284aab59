"""How the image of a camera in motion moves.

Longuet-Higgins and Prazdny, The interpretation of a moving retinal image, Proceedings of the Royal Society B, 1980.
"""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import twist


def motion_field(uv: Tensor, inverse_depth: Tensor, velocity: Tensor, camera: PinholeCamera) -> tuple[Tensor, Tensor]:
    """Speed of what is seen at some pixels.

    Args:
        uv: undistorted pixels, float64, shape :math:`(N, 2)`.
        inverse_depth: there, 1/m, float64, shape :math:`(N,)`; 0 is far away, which moves by the rotation alone.
        velocity: of the points in the camera, twist per second, float64, shape :math:`(6,)`.
        camera: intrinsics.

    Returns:
        Pixels per second, shape :math:`(N, 2)`, and the change of inverse depth, 1/m per second, shape :math:`(N,)`.
    """
    slopes = camera.slopes(uv).T
    # How points move for each metre of their depth: they are (x / z, y / z, 1, 1 / z) in such units.
    moves = twist(velocity)[:3] @ torch.cat([slopes, torch.ones_like(inverse_depth)[None], inverse_depth[None]])
    return (moves[:2] - moves[2] * slopes).T * camera.focal, -moves[2] * inverse_depth
