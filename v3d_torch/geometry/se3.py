"""SE(3) as 4x4 matrices: exponential, logarithm, inverse, action on points, adjoint, Jacobian of the logarithm.

Convention: a tangent vector is ``xi = [translation, rotation]``, metres and radians, in the order of PyPose's se(3).
All functions are batched over leading dimensions, differentiable, and meant for float64; exponential, logarithm and
orthonormalisation compute half precision in float32. Their results equal those of PyPose, but they use plain matrices,
which is faster for single poses.

Sola, Deray and Atchuthan, A micro Lie theory for state estimation in robotics, 2018.
"""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.geometry.argument_checks import check_shape
from v3d_torch.geometry.finite_matrices import zero_if_not_finite
from v3d_torch.geometry.gradients import needs_gradient, zero_with_gradient
from v3d_torch.geometry.precision import result_dtype, without_autocast, working_dtype
from v3d_torch.kernels import se3 as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array
from v3d_torch.kernels.reprojection import SMALL_ANGLE
from v3d_torch.kernels.se3 import SERIES_ANGLE_SQUARED

# Generators of se(3): row k is the derivative of se3_exp with respect to xi[k] at 0, a flattened 4x4 matrix.
_GENERATORS = torch.zeros(6, 4, 4, dtype=torch.float64)
_GENERATORS[(0, 1, 2), (0, 1, 2), 3] = 1.0
_GENERATORS[(3, 4, 5), (2, 0, 1), (1, 2, 0)] = 1.0
_GENERATORS[(3, 4, 5), (1, 2, 0), (2, 0, 1)] = -1.0
_GENERATORS = _GENERATORS.flatten(1)

# Linear map from a flattened rotation matrix R to 4 q q^T - I, flattened, with q = (w, x, y, z) the quaternion of R.
_QUATERNION_PRODUCTS = torch.tensor(
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


def _is_single(tensor: Tensor, *shape: int) -> bool:
    """Check whether a tensor is a single float64 element without batch dimensions, as the kernels expect."""
    return tensor.shape == shape and tensor.dtype == torch.float64


def to_matrix(R: Tensor, t: Tensor) -> Tensor:
    """Join rotations and translations to matrices with the last row (0, 0, 0, 1).

    Args:
        R: Rotations, or rotations times a scale, shape :math:`(..., 3, 3)`.
        t: Translations, shape :math:`(..., 3)`.

    Returns:
        Shape :math:`(..., 4, 4)`.
    """
    last = torch.eye(4, dtype=R.dtype, device=R.device)[3:].expand(*R.shape[:-2], 1, 4)
    return torch.cat([torch.cat([R, t[..., None]], dim=-1), last], dim=-2)


def _invert_compiled(T: Tensor) -> Tensor:
    return torch.from_numpy(kernels.invert(to_array(T))) if _is_single(T, 4, 4) else NotImplemented


@compiled_by(_invert_compiled)
def invert(T: Tensor) -> Tensor:
    """Invert rigid motions, shape :math:`(..., 4, 4)`: ``invert(T_wc)`` is ``T_cw``."""
    R = T[..., :3, :3].mT
    return to_matrix(R, 0.0 - (R @ T[..., :3, 3:])[..., 0])  # no negative zeros


def _orthonormalise_compiled(T: Tensor) -> Tensor:
    if T.dtype != torch.float64:
        return NotImplemented
    converged, result = kernels.orthonormalise(to_array(T.reshape(-1, 4, 4)))
    return torch.from_numpy(result).reshape(T.shape) if converged else NotImplemented


@compiled_by(_orthonormalise_compiled)
@without_autocast
def orthonormalise(T: Tensor) -> Tensor:
    """Replace rotations by the nearest orthonormal matrices.

    `invert` assumes orthonormal rotations, so a chain of products and inverses doubles its rounding error with each
    step. Poses are therefore orthonormalised before they are stored.

    Args:
        T: Rigid motions with rounding errors, shape :math:`(..., 4, 4)`.

    Returns:
        Rigid motions, dtype of ``T``, float32 for integers, shape :math:`(..., 4, 4)`, with (0, 0, 0, 1) as last row;
        NaN for rotations that are not finite.
    """
    dtype, T = result_dtype(T.dtype), T.to(working_dtype(T.dtype))
    M = T[..., :3, :3]
    finite, is_unknown = zero_if_not_finite(M.detach())
    U, _, Vh = torch.linalg.svd(finite)
    R = differentiable_rotation(torch.where(is_unknown, torch.nan, U @ Vh), M)
    return to_matrix(R, T[..., :3, 3]).to(dtype)


def differentiable_rotation(R: Tensor, M: Tensor) -> Tensor:
    """Return the rotations that are nearest to matrices with their derivatives with respect to these matrices.

    The derivatives are computed from the maximum of trace(R^T M) by the implicit function theorem, so that they are
    finite even where singular vectors have none: a rotation has three equal singular values.

    Args:
        R: Rotations without derivatives that maximise trace(R^T M), shape :math:`(..., 3, 3)`; NaN where ``M`` is not
            finite.
        M: Matrices, shape :math:`(..., 3, 3)`.

    Returns:
        The same rotations, shape :math:`(..., 3, 3)`.
    """
    if not needs_gradient(M):
        return R
    # Gradient and negated Hessian of trace(exp(phi)^T A) by phi, with A = M R^T.
    A = M @ R.mT
    gradient = torch.stack([A[..., i, j] - A[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], dim=-1)
    fixed = ((A + A.mT) / 2).detach()
    H = fixed.diagonal(dim1=-2, dim2=-1).sum(dim=-1)[..., None, None] * torch.eye(3, dtype=A.dtype, device=A.device)
    phi = (torch.linalg.pinv(zero_if_not_finite(H - fixed)[0], hermitian=True) @ gradient[..., None])[..., 0]
    turn = torch.cat([torch.zeros_like(phi), zero_with_gradient(phi)], dim=-1)
    return se3_exp(turn)[..., :3, :3] @ R


def are_rigid(T: Tensor, tolerance: float) -> Tensor:
    r"""Check whether matrices are rigid motions, up to the rounding of their rotations.

    Args:
        T: Matrices, floating point, shape :math:`(..., 4, 4)`.
        tolerance: Maximum difference between an element of :math:`R R^T` and of the identity.

    Returns:
        True for finite matrices with a rotation that is no reflection, and (0, 0, 0, 1) as last row, bool, shape
        :math:`(...)`.
    """
    R = T[..., :3, :3]
    identity = torch.eye(4, dtype=T.dtype, device=T.device)
    error = (R @ R.mT - identity[:3, :3]).abs().amax(dim=(-2, -1))
    is_affine = (T[..., 3, :] == identity[3]).all(dim=-1)
    # A comparison with NaN is false.
    return T.isfinite().all(dim=(-2, -1)) & is_affine & (error <= tolerance) & (torch.linalg.det(R) > 0)


def _se3_exp_compiled(xi: Tensor) -> Tensor:
    return torch.from_numpy(kernels.exp(to_array(xi))) if _is_single(xi, 6) else NotImplemented


@compiled_by(_se3_exp_compiled)
@without_autocast
def se3_exp(xi: Tensor) -> Tensor:
    r"""Exponential map of SE(3): the matrix exponential of :math:`\hat\xi`, in closed form.

    .. math::
        \exp \hat\xi = I + \hat\xi + \frac{1 - \cos\theta}{\theta^2} \hat\xi^2
            + \frac{\theta - \sin\theta}{\theta^3} \hat\xi^3, \qquad \theta = \|\phi\|, \quad \xi = [\rho, \phi]

    Args:
        xi: Tangent vectors ``[translation, rotation]``, metres and radians, shape :math:`(..., 6)`; any rotation angle.

    Returns:
        Rigid motions, dtype of ``xi``, float32 for integers, shape :math:`(..., 4, 4)`.
    """
    check_shape("xi", xi, "*", 6)
    dtype, xi = result_dtype(xi.dtype), xi.to(working_dtype(xi.dtype))
    X = hat(xi)
    # Below the small angle the coefficients are constant to float64, and are multiplied by high powers of the angle.
    # The square root of 0 would make second derivatives NaN.
    square = xi[..., 3:].square().sum(dim=-1)[..., None, None]
    angle = torch.where(square < SMALL_ANGLE**2, SMALL_ANGLE**2, square).sqrt()
    b = 2 * ((angle / 2).sin() / angle).square()
    c = (angle - angle.sin()) / angle**3
    X2 = X @ X
    return (torch.eye(4, dtype=xi.dtype, device=xi.device) + X).addcmul(b, X2).addcmul(c, X2 @ X).to(dtype)


def _se3_log_compiled(T: Tensor) -> Tensor:
    if T.dtype != torch.float64 or T.shape[-2:] != (4, 4):
        return NotImplemented
    return torch.from_numpy(kernels.logarithms(to_array(T.reshape(-1, 4, 4)))).reshape(*T.shape[:-2], 6)


@compiled_by(_se3_log_compiled)
@without_autocast
def se3_log(T: Tensor) -> Tensor:
    """Logarithm of SE(3), the inverse of `se3_exp`.

    Args:
        T: Rigid motions, shape :math:`(..., 4, 4)`.

    Returns:
        Tangent vectors ``[translation, rotation]``, metres and radians, dtype of ``T``, float32 for integers, shape
        :math:`(..., 6)`, with a rotation angle in [0, pi].
    """
    check_shape("T", T, "*", 4, 4)
    dtype, T = result_dtype(T.dtype), T.to(working_dtype(T.dtype))
    phi = _so3_log(T[..., :3, :3])
    square = (phi * phi).sum(dim=-1)[..., None, None]
    # torch.where evaluates both branches: the 1 keeps the unused branch and its gradient finite.
    is_small = square < SMALL_ANGLE**2
    safe = torch.where(is_small, 1.0, square)
    half = safe.sqrt() / 2
    c = torch.where(is_small, 1 / 12, (1 - half / half.tan()) / safe)
    K = _skew(phi)
    t = T[..., :3, 3:]
    rho = t - 0.5 * (K @ t) + c * (K @ (K @ t))
    return torch.cat([rho[..., 0], phi], dim=-1).to(dtype)


def transform_points(T_ba: Tensor, points: Tensor) -> Tensor:
    """Transform points from frame a to frame b; batch dimensions are broadcast.

    Args:
        T_ba: Transform, shape :math:`(*, 4, 4)`; converted to the dtype of the points.
        points: Points in frame a, shape :math:`(*, N, 3)`.

    Returns:
        Points in frame b, shape :math:`(*, N, 3)`.
    """
    T = T_ba.to(points)
    return points @ T[..., :3, :3].mT + T[..., None, :3, 3]


def interpolate(T_a: Tensor, T_b: Tensor, fraction: Tensor) -> Tensor:
    """Interpolate rigid motions along the geodesic between them, with a constant twist.

    Args:
        T_a: Rigid motions at fraction 0, shape :math:`(..., 4, 4)`.
        T_b: Rigid motions at fraction 1, shape :math:`(..., 4, 4)`.
        fraction: Fractions, shape :math:`(...)`.

    Returns:
        Rigid motions, shape :math:`(..., 4, 4)`.
    """
    return se3_exp(fraction[..., None] * se3_log(T_b @ invert(T_a))) @ T_a


def hat(xi: Tensor) -> Tensor:
    r"""Hat operator of se(3): tangent vectors as matrices.

    Args:
        xi: Tangent vectors :math:`[\rho, \phi]`, shape :math:`(..., 6)`.

    Returns:
        Matrices :math:`\begin{pmatrix} {[\phi]}_\times & \rho \\ 0 & 0 \end{pmatrix}`, shape :math:`(..., 4, 4)`.
    """
    return (xi @ _GENERATORS.to(xi)).unflatten(-1, (4, 4))


def _skew(v: Tensor) -> Tensor:
    """Matrices (..., 3, 3) of the cross product with vectors (..., 3)."""
    return hat(torch.cat([v, v], dim=-1))[..., :3, :3]


def _adjoint_compiled(T: Tensor) -> Tensor:
    return torch.from_numpy(kernels.adjoint(to_array(T))) if _is_single(T, 4, 4) else NotImplemented


@compiled_by(_adjoint_compiled)
def adjoint(T: Tensor) -> Tensor:
    r"""Adjoint of rigid motions: :math:`T \exp(\xi) = \exp(\mathrm{Ad}_T\, \xi)\, T`.

    Args:
        T: Rigid motions, shape :math:`(..., 4, 4)`.

    Returns:
        Matrices :math:`\begin{pmatrix} R & {[t]}_\times R \\ 0 & R \end{pmatrix}`, shape :math:`(..., 6, 6)`.
    """
    R = T[..., :3, :3]
    return _block_triangular(R, _skew(T[..., :3, 3]) @ R)


def left_jacobian_inverse(xi: Tensor) -> Tensor:
    r"""Inverse left Jacobian of SE(3), the derivative of the logarithm with respect to a perturbation on the left.

    With the adjoint :math:`A` of the tangent vector,

    .. math::
        \log(\exp(\epsilon) \exp(\xi)) = \xi + J^{-1} \epsilon + O(\epsilon^2), \qquad
        J^{-1} = I - \frac{1}{2} A + a A^2 + b A^4

    Barfoot, State Estimation for Robotics, 2017, Sec. 7.1.5.

    Args:
        xi: Tangent vectors ``[translation, rotation]``, shape :math:`(..., 6)`, with a rotation angle of at most pi.

    Returns:
        Shape :math:`(..., 6, 6)`.
    """
    K = _skew(xi[..., 3:])
    A = _block_triangular(K, _skew(xi[..., :3]))
    square = xi[..., 3:].square().sum(dim=-1)[..., None, None]
    # A has the eigenvalues 0 and +-i angle, each twice, so that the series x / 2 coth(x / 2) of A ends at A^4.
    is_small = square < SERIES_ANGLE_SQUARED
    safe = torch.where(is_small, 1.0, square)
    angle = safe.sqrt()
    cotangent = 1 / (angle / 2).tan()
    value, slope = angle / 2 * cotangent, cotangent / 2 - angle / (4 * (angle / 2).sin().square())
    b = torch.where(is_small, -1 / 720 - square / 15120, (1 + angle * slope / 2 - value) / safe.square())
    a = torch.where(is_small, 1 / 12 - square.square() / 30240, 2 * b * safe - slope / (2 * angle))
    A2 = A @ A
    return torch.eye(6, dtype=xi.dtype, device=xi.device) - 0.5 * A + a * A2 + b * (A2 @ A2)


def _block_triangular(D: Tensor, B: Tensor) -> Tensor:
    """Matrices (..., 6, 6) of blocks (..., 3, 3): D, B above, 0, D below."""
    return torch.cat([torch.cat([D, B], dim=-1), torch.cat([torch.zeros_like(D), D], dim=-1)], dim=-2)


def _so3_log(R: Tensor) -> Tensor:
    """Rotation vectors (..., 3) of rotations (..., 3, 3), computed via quaternions: well conditioned up to pi."""
    # Each row of 4 q q^T is a multiple of the quaternion q; the longest row has the smallest relative error.
    rows = (R.flatten(-2) @ _QUATERNION_PRODUCTS.to(R)).unflatten(-1, (4, 4))
    rows = rows + torch.eye(4, dtype=R.dtype, device=R.device)
    longest = rows.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    q = torch.take_along_dim(rows, longest[..., None, None], dim=-2)[..., 0, :]
    q = q / q.norm(dim=-1, keepdim=True)
    q = torch.where(q[..., :1] < 0, -q, q)  # q and -q are the same rotation; w >= 0 gives an angle of at most pi
    w, v = q[..., :1], q[..., 1:]
    square = (v * v).sum(dim=-1, keepdim=True)
    is_small = square < SMALL_ANGLE**2
    sine = torch.where(is_small, 1.0, square).sqrt()
    return v * torch.where(is_small, 2 / w.clamp(min=0.5) * (1 - square / 3), 2 * torch.atan2(sine, w) / sine)
