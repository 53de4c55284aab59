"""Least-squares alignment of corresponding points (Umeyama, PAMI 1991)."""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.geometry.argument_checks import check_masks
from v3d_torch.geometry.finite_matrices import zero_if_not_finite
from v3d_torch.geometry.long_products import sum_products
from v3d_torch.geometry.precision import result_dtype
from v3d_torch.geometry.se3 import differentiable_rotation, to_matrix
from v3d_torch.runtime.batches import check_shapes, check_weights, fill_padding, mask_or_all

_SAME_PLACE = 1e-12
"""Largest distance of points at one place from their mean, as a fraction of their distance from the origin. Rounding of
the mean causes a fraction of some 1e-15."""


def umeyama(
    p: Tensor,
    q: Tensor,
    weights: Tensor | None = None,
    valid: Tensor | None = None,
    *,
    with_scale: bool = False,
) -> Tensor:
    r"""Align points by the rigid or similarity transform with the smallest squared error.

    .. math::
        \min_{s, R, t} \sum_i w_i \|q_i - (s R p_i + t)\|^2

    Differentiable in all floating-point inputs, also where points lie in a plane. Reflections are excluded.

    Umeyama, Least-Squares Estimation of Transformation Parameters Between Two Point Patterns, PAMI 1991.

    Args:
        p: Points in frame p, metres, floating point, shape :math:`(*, N, 3)`; converted to float64.
        q: The same points in frame q, shape :math:`(*, N, 3)`.
        weights: Weight of each pair, not negative, shape :math:`(*, N)`; None for 1.
        valid: Mask of the pairs that are not padding, bool, shape :math:`(*, N)`; None for all.
        with_scale: True to estimate the scale, false for a scale of 1.

    Returns:
        Transform ``T_qp``, with the scaled rotation :math:`s R` in its upper left block, dtype of ``p``,
        float32 for integers, shape :math:`(*, 4, 4)`. Points on a line do not determine the rotation; one of the
        solutions is returned. Without points the result is the identity; points at one place do not determine the
        scale, which is then 1. It is NaN if a point is not finite.

    Raises:
        InputError: If ``valid`` is not bool, or if a weight is negative, infinite or NaN.
    """
    check_masks(valid=valid)
    check_shapes(p=(p, "N", 3), q=(q, "N", 3), weights=(weights, "N"), valid=(valid, "N"))
    if weights is not None:
        check_weights(weights, mask_or_all(valid, weights))
    each = None if valid is None else valid[..., None]
    a, b = fill_padding(p, each, 0.0), fill_padding(q, each, 0.0)
    if weights is None:
        w = None if each is None else each.to(torch.float64)
    else:
        w = fill_padding(weights, valid, 0.0)[..., None]
    mean_a, mean_b = (weighted_mean(points, w) for points in (a, b))
    size = _sum_of_squares(a, w) if with_scale else None
    a, b = a - mean_a[..., None, :], b - mean_b[..., None, :]
    M = sum_products(b if w is None else b * w, a)
    R = nearest_rotation(M)
    if size is not None:
        spread = _sum_of_squares(a, w)
        is_spread = spread > _SAME_PLACE**2 * size
        scale = (R * M).sum(dim=(-2, -1)) / torch.where(is_spread, spread, 1.0)
        R = R * torch.where(is_spread, scale, 1.0)[..., None, None]
    return to_matrix(R, mean_b - (R @ mean_a[..., None])[..., 0]).to(result_dtype(p.dtype))


def weighted_mean(points: Tensor, weights: Tensor | None) -> Tensor:
    """Mean of points; 0 without points.

    Args:
        points: Shape :math:`(..., N, d)`.
        weights: Shape :math:`(..., N, 1)`; None for equal weights.

    Returns:
        Shape :math:`(..., d)`.
    """
    if weights is None:
        return points.mean(dim=-2) if points.shape[-2] else points.sum(dim=-2)
    total = weights.sum(dim=-2)
    return (weights * points).sum(dim=-2) / torch.where(total > 0, total, 1.0)


def _sum_of_squares(points: Tensor, weights: Tensor | None) -> Tensor:
    """Weighted sum of the squared distances of points (..., N, 3) from the origin, (...)."""
    return (points.square() if weights is None else points.square() * weights).sum(dim=(-2, -1))


def nearest_rotation(M: Tensor) -> Tensor:
    """Rotation R that maximises trace(R^T M), for matrices of shape (..., 3, 3); NaN if they are not finite.

    The gradient is computed from the maximum, so that it is finite even where singular vectors have no gradient.
    """
    finite, is_unknown = zero_if_not_finite(M.detach())
    U, _, Vh = torch.linalg.svd(finite)
    signs = torch.stack([*torch.ones_like(finite[..., :2, 0]).unbind(-1), torch.linalg.det(U @ Vh).sign()], dim=-1)
    R = torch.where(is_unknown, torch.nan, (U * signs[..., None, :]) @ Vh)  # the last sign excludes reflections
    return differentiable_rotation(R, M)
