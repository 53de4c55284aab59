r"""Perspective-three-point problem: camera poses from three points and their viewing directions.

The distances :math:`s_1, s_2, s_3` of the points satisfy three laws of cosines. With :math:`s_2 = u s_1` and
:math:`s_3 = v s_1` they reduce to a polynomial of degree four in v (Grunert, 1841; Haralick et al., Review and Analysis
of Solutions of the Three Point Perspective Pose Estimation Problem, IJCV 1994).
"""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.geometry.se3 import invert, to_matrix

_ROOT_ITERATIONS = 40
"""Iterations for the roots: some dozens from the start to the neighbourhood of the roots, then convergence is
quadratic."""


def solve_p3p(points: Tensor, directions: Tensor) -> Tensor:
    """Solve the perspective-three-point problem: poses of a camera that observes three points in given directions.

    Args:
        points: Three points in a frame "w", metres, float64, shape :math:`(..., 3, 3)`, one in each row.
        directions: Viewing directions of the points, of any length, shape :math:`(..., 3, 3)`.

    Returns:
        World-to-camera poses ``T_cw`` of the four solutions, shape :math:`(..., 4, 4, 4)`. Poses of complex solutions
        do not fit the points; degenerate points give NaN.
    """
    f = torch.nn.functional.normalize(directions, dim=-1)
    cos_a, cos_b, cos_c = ((f[..., i, :] * f[..., j, :]).sum(dim=-1) for i, j in ((1, 2), (0, 2), (0, 1)))
    a, b, c = ((points[..., i, :] - points[..., j, :]).square().sum(dim=-1) for i, j in ((1, 2), (0, 2), (0, 1)))
    p, q, r, s = (a - c) / b, (a + c) / b, (b - c) / b, (b - a) / b
    coefficients = (
        (1 + p).square() - 4 * a / b * cos_c.square(),
        4 * (-p * (1 + p) * cos_b + 2 * a / b * cos_c.square() * cos_b - (1 - q) * cos_a * cos_c),
        2 * (p * p - 1 + 2 * p * p * cos_b.square() + 2 * r * cos_a.square())
        + 4 * (s * cos_c.square() - 2 * q * cos_a * cos_b * cos_c),
        4 * (p * (1 - p) * cos_b - (1 - q) * cos_a * cos_c + 2 * c / b * cos_a.square() * cos_b),
        (p - 1).square() - 4 * c / b * cos_a.square(),
    )
    v = _real_parts_of_roots(torch.stack(coefficients, dim=-1))
    p, cos_a, cos_b, cos_c = (each[..., None] for each in (p, cos_a, cos_b, cos_c))  # one for each root
    u = ((p - 1) * v * v - 2 * p * cos_b * v + 1 + p) / (2 * (cos_c - v * cos_a))
    s1 = (b[..., None] / (1 + v * v - 2 * v * cos_b)).sqrt()
    in_camera = torch.stack([s1, u * s1, v * s1], dim=-1)[..., None] * f[..., None, :, :]
    return _align_triangles(points[..., None, :, :].expand_as(in_camera), in_camera)


def _real_parts_of_roots(coefficients: Tensor) -> Tensor:
    """Real parts of the roots of quartic polynomials, lowest coefficient first, (..., 5) to (..., 4).

    Simultaneous iteration of all roots (Durand, 1960; Kerner, 1966).
    """
    monic = (coefficients[..., :4] / coefficients[..., 4:])[..., None, :]
    # The start must be neither real nor on a circle; it is scaled by an upper bound of the roots.
    start = torch.tensor([0.4 + 0.9j], dtype=torch.complex128, device=coefficients.device) ** torch.arange(
        4, device=coefficients.device
    )
    z = start * (1 + monic.abs().amax(dim=-1).clamp(max=4.0))
    others = ~torch.eye(4, dtype=torch.bool, device=coefficients.device)
    for _ in range(_ROOT_ITERATIONS):
        value = z + monic[..., 3]
        for k in (2, 1, 0):
            value = value * z + monic[..., k]
        differences = torch.where(others, z[..., :, None] - z[..., None, :], 1.0)
        z = z - value / differences.prod(dim=-1)
    return z.real


def _align_triangles(world: Tensor, camera: Tensor) -> Tensor:
    """Rigid motions (..., 4, 4) that map triangles ``world`` to congruent triangles ``camera``, both (..., 3, 3)."""
    frames = []
    for corners in (world, camera):
        first, second, third = corners.unbind(dim=-2)
        x = torch.nn.functional.normalize(second - first, dim=-1)
        z = torch.nn.functional.normalize(torch.linalg.cross(x, third - first, dim=-1), dim=-1)
        axes = torch.stack([x, torch.linalg.cross(z, x, dim=-1), z], dim=-1)
        frames.append(to_matrix(axes, first))
    T_wt, T_ct = frames
    return T_ct @ invert(T_wt)
