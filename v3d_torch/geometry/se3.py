"""Rigid motions as 4x4 matrices: exponential, logarithm, inverse (Sola et al., A micro Lie theory, 2018).

Convention: a tangent vector is ``[translation, rotation]``, metres and radians, as PyPose orders se(3). Everything is
batched over leading dimensions, differentiable, and meant for float64. PyPose computes the same; these work on plain
matrices, in a tenth of the time for a single pose.
"""

from __future__ import annotations

import torch
from torch import Tensor

# Row k is the derivative of se3_exp by xi[k] at 0: its 4x4 matrix, flattened.
_GENERATORS = torch.zeros(6, 4, 4, dtype=torch.float64)
_GENERATORS[(0, 1, 2), (0, 1, 2), 3] = 1.0
_GENERATORS[(3, 4, 5), (2, 0, 1), (1, 2, 0)] = 1.0
_GENERATORS[(3, 4, 5), (1, 2, 0), (2, 0, 1)] = -1.0
_GENERATORS = _GENERATORS.flatten(1)

# 4 q q^T of the quaternion q = (w, x, y, z) of a rotation, less the identity, is made of its nine numbers, row by row.
_SQUARES = torch.tensor(
    [
        [1, 0, 0, 0, 1, 0, 0, 0, 1],  # ww
        [0, 0, 0, 0, 0, -1, 0, 1, 0],  # wx
        [0, 0, 1, 0, 0, 0, -1, 0, 0],  # wy
        [0, -1, 0, 1, 0, 0, 0, 0, 0],  # wz
        [0, 0, 0, 0, 0, -1, 0, 1, 0],  # xw
        [1, 0, 0, 0, -1, 0, 0, 0, -1],  # xx
        [0, 1, 0, 1, 0, 0, 0, 0, 0],  # xy
        [0, 0, 1, 0, 0, 0, 1, 0, 0],  # xz
        [0, 0, 1, 0, 0, 0, -1, 0, 0],  # yw
        [0, 1, 0, 1, 0, 0, 0, 0, 0],  # yx
        [-1, 0, 0, 0, 1, 0, 0, 0, -1],  # yy
        [0, 0, 0, 0, 0, 1, 0, 1, 0],  # yz
        [0, -1, 0, 1, 0, 0, 0, 0, 0],  # zw
        [0, 0, 1, 0, 0, 0, 1, 0, 0],  # zx
        [0, 0, 0, 0, 0, 1, 0, 1, 0],  # zy
        [-1, 0, 0, 0, -1, 0, 0, 0, 1],  # zz
    ],
    dtype=torch.float64,
).T

_SMALL = 1e-4  # angle below which the limits of the closed forms are exact to float64
_TINY = _SMALL**2


def invert(T: Tensor) -> Tensor:
    """Inverse of rigid motions, shape :math:`(..., 4, 4)`: ``invert(T_wc)`` is ``T_cw``."""
    R = T[..., :3, :3].mT
    return _motion(R, -(R @ T[..., :3, 3:]))


def rigid(T: Tensor) -> Tensor:
    """The rigid motions nearest to matrices that rounding has bent, shape :math:`(..., 4, 4)`.

    `invert` takes rotations for orthonormal, so that a chain of products and inverses doubles its rounding error at
    each link: a pose that is kept is put right first. The last row becomes (0, 0, 0, 1), whatever it was.
    """
    U, _, Vh = torch.linalg.svd(T[..., :3, :3])
    return _motion(U @ Vh, T[..., :3, 3:])


def _motion(R: Tensor, t: Tensor) -> Tensor:
    """Rotations (..., 3, 3) and translations (..., 3, 1) as one. The last row is exact: its error would double, too."""
    last = R.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*R.shape[:-2], 1, 4)
    return torch.cat([torch.cat([R, t], dim=-1), last], dim=-2)


def se3_exp(xi: Tensor) -> Tensor:
    """Exponential map: the matrix exponential of its `twist`, by its closed form.

    Args:
        xi: ``[translation, rotation]``, shape :math:`(..., 6)`; rotations by any angle.

    Returns:
        Rigid motions, shape :math:`(..., 4, 4)`.
    """
    X = twist(xi)
    # Below, the coefficients are multiplied by next to nothing: those of a small angle are exact enough at any smaller.
    angle = torch.linalg.vector_norm(xi[..., 3:], dim=-1)[..., None, None].clamp(min=_SMALL)
    b = 2 * ((angle / 2).sin() / angle).square()
    c = (angle - angle.sin()) / angle**3
    X2 = X @ X
    return (torch.eye(4, dtype=xi.dtype) + X).addcmul(b, X2).addcmul(c, X2 @ X)


def se3_log(T: Tensor) -> Tensor:
    """Logarithm, the inverse of `se3_exp`.

    Args:
        T: rigid motions, shape :math:`(..., 4, 4)`.

    Returns:
        ``[translation, rotation]``, shape :math:`(..., 6)`, the rotation by an angle in [0, pi].
    """
    phi = _so3_log(T[..., :3, :3])
    square = (phi * phi).sum(dim=-1)[..., None, None]
    # torch.where evaluates both branches: the 1 keeps the one not taken, and its gradient, finite.
    safe = torch.where(square < _TINY, 1.0, square)
    half = safe.sqrt() / 2
    c = torch.where(square < _TINY, 1 / 12, (1 - half / half.tan()) / safe)
    K = twist(torch.cat([phi, phi], dim=-1))[..., :3, :3]
    t = T[..., :3, 3:]
    rho = t - 0.5 * (K @ t) + c * (K @ (K @ t))
    return torch.cat([rho[..., 0], phi], dim=-1)


def twist(xi: Tensor) -> Tensor:
    """Tangent vectors as matrices, ``[[rotation x, translation], [0, 0]]``, :math:`(..., 6)` to :math:`(..., 4, 4)`."""
    return (xi @ _GENERATORS.to(xi.dtype)).unflatten(-1, (4, 4))


def _so3_log(R: Tensor) -> Tensor:
    """Rotation vectors, :math:`(..., 3, 3)` to :math:`(..., 3)`, by way of quaternions: well conditioned up to pi."""
    # The sixteen numbers 4 q q^T of the quaternion q = (w, x, y, z): each row a multiple of q, the longest the safest.
    rows = (R.flatten(-2) @ _SQUARES.to(R.dtype)).unflatten(-1, (4, 4)) + torch.eye(4, dtype=R.dtype)
    longest = rows.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    q = torch.take_along_dim(rows, longest[..., None, None], dim=-2)[..., 0, :]
    q = q / q.norm(dim=-1, keepdim=True)
    q = torch.where(q[..., :1] < 0, -q, q)  # q and -q are one rotation; this one turns by at most pi
    w, v = q[..., :1], q[..., 1:]
    square = (v * v).sum(dim=-1, keepdim=True)
    sine = torch.where(square < _TINY, 1.0, square).sqrt()
    return v * torch.where(square < _TINY, 2 / w.clamp(min=0.5) * (1 - square / 3), 2 * torch.atan2(sine, w) / sine)
