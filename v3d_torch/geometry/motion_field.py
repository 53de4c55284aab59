r"""Motion field: image velocity of points observed by a moving camera.

A point with normalised image coordinates :math:`(x, y)` and inverse depth :math:`w` that moves in the camera frame by
the twist :math:`(v, \omega)`, that is :math:`\dot p = v + \omega \times p`, has

.. math::
    \dot x = w v_x + \omega_y - \omega_z y - x s, \qquad
    \dot y = w v_y + \omega_z x - \omega_x - y s, \qquad
    \dot w = -w s, \qquad
    s = \dot z / z = w v_z + \omega_x y - \omega_y x

Longuet-Higgins and Prazdny, The interpretation of a moving retinal image, Proceedings of the Royal Society B, 1980.
"""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.geometry.se3 import hat


def motion_field(uv: Tensor, inverse_depth: Tensor, velocity: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """Velocity of pixels and of their inverse depth, for static points in front of a moving camera.

    Args:
        uv: Undistorted pixels, float64, shape :math:`(..., N, 2)`.
        inverse_depth: Inverse depth of each pixel, 1/m, float64, shape :math:`(..., N)`; 0 = infinitely far, so that
            only the rotation moves the pixel.
        velocity: Twist ``[m/s, rad/s]`` by which the points move in the camera frame, float64, shape
            :math:`(..., 6)`: ``T_cw`` becomes ``exp(velocity * dt) @ T_cw``.
        K: Camera matrix, float64, shape :math:`(..., 3, 3)`.

    Returns:
        Pixel velocity, pixels per second, shape :math:`(..., N, 2)`, and the rate of inverse depth, 1/m per second,
        shape :math:`(..., N)`.
    """
    focal_lengths, principal_point = K.diagonal(dim1=-2, dim2=-1)[..., None, :2], K[..., None, :2, 2]
    xy = ((uv - principal_point) / focal_lengths).mT
    # Velocity of the points divided by their depth; in these units the points are (x / z, y / z, 1, 1 / z).
    x, y = xy.unbind(dim=-2)
    points = torch.stack(torch.broadcast_tensors(x, y, torch.ones_like(x), inverse_depth), dim=-2)
    relative = hat(velocity)[..., :3, :] @ points
    rate = relative[..., 2:, :]
    return (relative[..., :2, :] - rate * xy).mT * focal_lengths, -rate[..., 0, :] * inverse_depth
