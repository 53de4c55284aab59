"""Absolute trajectory error (Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012)."""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple

import torch
from torch import Tensor

from v3d_torch.evaluation.umeyama import nearest_rotation, umeyama, weighted_mean
from v3d_torch.geometry.argument_checks import check_masks, check_not_jit_traced
from v3d_torch.geometry.finite_matrices import zero_if_not_finite
from v3d_torch.geometry.long_products import sum_products
from v3d_torch.geometry.precision import result_dtype
from v3d_torch.geometry.se3 import to_matrix
from v3d_torch.runtime.batches import check_shapes, fill_padding, mask_or_all

_MIN_PLANE_SPREAD = 1e-3
"""Minimum standard deviation of the positions along their second principal axis, metres. Positions with less spread do
not determine the rotation of an alignment: the spread is no larger than the noise of motion capture."""

_MIN_SCALE_FACTOR = 1.5
"""Minimum ratio between the sizes of two trajectories for a scale error: drift changes the size by less, a wrong unit
of depth by more."""

_MIN_PATH_SPREAD = 0.05
"""Minimum root mean square distance of the true positions from their mean, for a scale error, metres. On shorter paths,
tracking errors that depend on the motion of the camera can be as large as the path and have its shape."""

_MAX_UNEXPLAINED_VARIANCE = 0.25
"""Maximum fraction of the ground truth's variance that a rescaled estimate does not explain, for a scale error. With a
larger fraction, the estimate has another shape, and its size does not indicate the unit of depth."""


class RotationSource(StrEnum):
    """Source of the rotation of an alignment."""

    POSITIONS = "positions"
    ORIENTATIONS = "orientations"


class Alignment(NamedTuple):
    """Rigid alignment of estimates to their ground truths.

    Attributes:
        T_ge: Transform from the estimate's world to the ground truth's world, ``T_gc = T_ge @ T_ec``, float64, shape
            :math:`(..., 4, 4)`.
        by_orientations: True if the rotation is the mean of the orientation differences, bool, shape :math:`(...)`.
    """

    T_ge: Tensor
    by_orientations: Tensor

    @property
    def source(self) -> RotationSource:
        """Source of the rotation, for a single alignment."""
        return RotationSource.ORIENTATIONS if bool(self.by_orientations) else RotationSource.POSITIONS


def ate(T_gc: Tensor, T_ec: Tensor, valid: Tensor | None = None) -> Tensor:
    r"""Absolute trajectory error: root mean square distance of positions after a rigid alignment.

    .. math::
        \mathrm{ATE} = \sqrt{ \frac{1}{n} \sum_i \left\| \mathrm{trans}(T_{ge} T_{ec, i}) - \mathrm{trans}(T_{gc, i})
            \right\|^2 }

    The alignment ``T_ge`` is the least-squares fit of the positions. If the positions of the ground truth do not span a
    plane, its rotation is the mean of the orientation differences. Differentiable in both trajectories.

    Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012.

    Args:
        T_gc: Ground truth, camera-to-world poses, floating point, shape :math:`(*, N, 4, 4)`; converted to float64.
        T_ec: Estimate at the same times, camera-to-world poses in any world, shape :math:`(*, N, 4, 4)`.
        valid: Mask of the poses that are not padding, bool, shape :math:`(*, N)`; None for all.

    Returns:
        ATE, metres, dtype of ``T_ec``, float32 for integers, shape :math:`(*)`; NaN without poses, or if a
        pose is not finite.

    Raises:
        InputError: If ``valid`` is not bool, or in `torch.jit.trace`.
    """
    check_not_jit_traced("ate")
    check_masks(valid=valid)
    check_shapes(T_gc=(T_gc, "N", 4, 4), T_ec=(T_ec, "N", 4, 4), valid=(valid, "N"))
    each = None if valid is None else valid[..., None, None]
    truth, estimate = fill_padding(T_gc, each, 0.0), fill_padding(T_ec, each, 0.0)
    errors = absolute_errors(truth, estimate, align(truth, estimate, valid))
    return root_mean_square(errors, valid).to(result_dtype(T_ec.dtype))


def root_mean_square(errors: Tensor, valid: Tensor | None) -> Tensor:
    """Root mean square of the errors that are valid, shape (..., N) to (...); its gradient at 0 is 0."""
    present = mask_or_all(valid, errors)
    norm = torch.linalg.vector_norm(torch.where(present, errors, 0.0), dim=-1)
    return norm / present.sum(dim=-1).to(errors.dtype).sqrt()


def spans_plane(positions: Tensor, valid: Tensor | None = None) -> Tensor:
    """Check whether positions span a plane, so that they determine the rotation of an alignment.

    Positions of a camera that stands still, only turns, or moves along a line do not span a plane.

    Args:
        positions: Camera positions, metres, shape :math:`(..., N, 3)`.
        valid: Mask of the positions that are not padding, bool, shape :math:`(..., N)`; None for all.

    Returns:
        Bool, shape :math:`(...)`; false if a position is not finite.
    """
    each = None if valid is None else valid[..., None]
    centred = positions - weighted_mean(positions, None if each is None else each.to(positions.dtype))[..., None, :]
    if each is None:
        count: Tensor | int = max(positions.shape[-2], 1)
    else:
        centred, count = torch.where(each, centred, 0.0), each.sum(dim=-2, keepdim=True).clamp(min=1)
    covariance, _ = zero_if_not_finite(sum_products(centred, centred) / count)
    spread = torch.linalg.eigvalsh(covariance).clamp(min=0).sqrt()  # increasing
    return spread[..., 1] > _MIN_PLANE_SPREAD


def align(T_gc: Tensor, T_ec: Tensor, valid: Tensor | None = None, *, oriented: bool = True) -> Alignment:
    """Align estimates to their ground truths by a rigid transform, without scale (Umeyama, PAMI 1991).

    The alignment is the least-squares fit of the positions. If the positions of the ground truth do not span a plane,
    they do not determine the rotation: the rotation is then the mean of the orientation differences, and the
    translation follows from the centroids.

    Args:
        T_gc: Ground truth, camera-to-world poses, float64, shape :math:`(..., N, 4, 4)`.
        T_ec: Estimate at the same times, camera-to-world poses, float64, shape :math:`(..., N, 4, 4)`.
        valid: Mask of the poses that are not padding, bool, shape :math:`(..., N)`; None for all.
        oriented: True if the orientations of the ground truth were measured.
    """
    p_g, p_e = T_gc[..., :3, 3], T_ec[..., :3, 3]
    T_ge = umeyama(p_e, p_g, valid=valid)
    by_orientations = ~spans_plane(p_g.detach(), valid) & oriented
    between = T_gc[..., :3, :3] @ T_ec[..., :3, :3].mT
    R = nearest_rotation((between if valid is None else between * valid[..., None, None]).sum(dim=-3))
    weights = None if valid is None else valid[..., None].to(p_g.dtype)
    t = weighted_mean(p_g, weights) - (R @ weighted_mean(p_e, weights)[..., None])[..., 0]
    return Alignment(torch.where(by_orientations[..., None, None], to_matrix(R, t), T_ge), by_orientations)


def absolute_errors(T_gc: Tensor, T_ec: Tensor, alignment: Alignment) -> Tensor:
    """Compute the distance between each aligned position and the ground truth.

    Args:
        T_gc: Ground truth, camera-to-world poses, shape :math:`(..., N, 4, 4)`.
        T_ec: Estimate at the same times, camera-to-world poses, shape :math:`(..., N, 4, 4)`.
        alignment: Alignment of the estimate to the ground truth, from `align`.

    Returns:
        Position errors, metres, shape :math:`(..., N)`.
    """
    aligned = alignment.T_ge[..., None, :, :] @ T_ec
    return (aligned[..., :3, 3] - T_gc[..., :3, 3]).norm(dim=-1)


def scale_error(T_gc: Tensor, T_ec: Tensor, alignment: Alignment) -> float | None:
    """Compute the scale error of an estimate that has the right shape but the wrong size.

    Such an estimate results from depth in the wrong unit.

    Args:
        T_gc: Ground truth, camera-to-world poses, shape :math:`(N, 4, 4)`.
        T_ec: Estimate at the same times, camera-to-world poses, shape :math:`(N, 4, 4)`.
        alignment: Alignment of the estimate to the ground truth, from `align`.

    Returns:
        Size of the ground truth divided by the size of the estimate. None if both sizes agree within a factor of
        `_MIN_SCALE_FACTOR`, if the shapes differ (more than `_MAX_UNEXPLAINED_VARIANCE` after rescaling), or if the
        true positions spread less than `_MIN_PATH_SPREAD`.
    """
    p_g, p_e = T_gc[:, :3, 3], (alignment.T_ge @ T_ec)[:, :3, 3]
    p_g, p_e = p_g - p_g.mean(dim=0), p_e - p_e.mean(dim=0)
    if p_g.square().sum(dim=-1).mean().sqrt() < _MIN_PATH_SPREAD:
        return None
    factor = float((p_g * p_e).sum() / p_e.square().sum())
    unexplained = (factor * p_e - p_g).square().sum() / p_g.square().sum()
    same_size = 1 / _MIN_SCALE_FACTOR < factor < _MIN_SCALE_FACTOR
    return factor if factor > 0 and not same_size and unexplained < _MAX_UNEXPLAINED_VARIANCE else None
