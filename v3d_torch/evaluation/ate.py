"""Absolute trajectory error (Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import torch
from torch import Tensor

_MIN_PLANE_SPREAD = 1e-3
"""Minimum standard deviation of the positions along their second principal axis, metres. Positions with less spread do
not determine the rotation of an alignment: the spread is no larger than the noise of motion capture."""

_MIN_SCALE_FACTOR = 1.5
"""Minimum ratio between the sizes of two trajectories to report a scale error. Drift changes the size by less; a wrong
unit of depth changes it by more."""

_MAX_UNEXPLAINED_VARIANCE = 0.25
"""Maximum fraction of the ground truth's variance that a rescaled estimate leaves unexplained, for a scale error. With
more, the estimate has another shape, and its size does not indicate the unit of depth."""


class RotationSource(StrEnum):
    """Source of the rotation of an alignment."""

    POSITIONS = "positions"
    ORIENTATIONS = "orientations"


@dataclass(frozen=True)
class Alignment:
    """Rigid alignment of an estimate to its ground truth.

    Attributes:
        T_ge: Transform from the estimate's world to the ground truth's world, ``T_gc = T_ge @ T_ec``, float64, shape
            :math:`(4, 4)`.
        source: Source of the rotation.
    """

    T_ge: Tensor
    source: RotationSource


def spans_plane(positions: Tensor) -> bool:
    """Check whether positions span a plane, and so determine the rotation of an alignment.

    Positions of a camera that stands still, only turns, or moves along a line do not.

    Args:
        positions: Camera positions, metres, shape :math:`(N, 3)`.
    """
    centred = positions - positions.mean(dim=0)
    spread = torch.linalg.eigvalsh(centred.mT @ centred / len(positions)).clamp(min=0).sqrt()  # increasing
    return bool(spread[1] > _MIN_PLANE_SPREAD)


def align(T_gc: Tensor, T_ec: Tensor, *, oriented: bool = True) -> Alignment:
    """Align the estimate to the ground truth by a rigid transform, without scale (Umeyama, PAMI 1991).

    The alignment is the least-squares fit of the positions. If the positions of the ground truth do not span a plane,
    they do not determine the rotation: the rotation is then the mean of the orientation differences, and the
    translation follows from the centroids.

    Args:
        T_gc: Ground truth, camera-to-world poses, float64, shape :math:`(N, 4, 4)`.
        T_ec: Estimate at the same times, camera-to-world poses, float64, shape :math:`(N, 4, 4)`.
        oriented: True if the orientations of the ground truth were measured.
    """
    p_g, p_e = T_gc[:, :3, 3], T_ec[:, :3, 3]
    mean_g, mean_e = p_g.mean(dim=0), p_e.mean(dim=0)
    if oriented and not spans_plane(p_g):
        source = RotationSource.ORIENTATIONS
        R_ge = _nearest_rotation((T_gc[:, :3, :3] @ T_ec[:, :3, :3].mT).sum(dim=0))
    else:
        source = RotationSource.POSITIONS
        R_ge = _nearest_rotation((p_g - mean_g).mT @ (p_e - mean_e))
    T_ge = torch.eye(4, dtype=T_gc.dtype)
    T_ge[:3, :3] = R_ge
    T_ge[:3, 3] = mean_g - R_ge @ mean_e
    return Alignment(T_ge, source)


def absolute_errors(T_gc: Tensor, T_ec: Tensor, alignment: Alignment) -> Tensor:
    """Compute the distance between each aligned position and the ground truth.

    Args:
        T_gc: Ground truth, camera-to-world poses, shape :math:`(N, 4, 4)`.
        T_ec: Estimate at the same times, camera-to-world poses, shape :math:`(N, 4, 4)`.
        alignment: Alignment of the estimate to the ground truth, from `align`.

    Returns:
        Position errors, metres, shape :math:`(N,)`.
    """
    return ((alignment.T_ge @ T_ec)[:, :3, 3] - T_gc[:, :3, 3]).norm(dim=-1)


def scale_error(T_gc: Tensor, T_ec: Tensor, alignment: Alignment) -> float | None:
    """Compute the scale error of an estimate that has the right shape but the wrong size.

    Such an estimate results from depth in the wrong unit.

    Args:
        T_gc: Ground truth, camera-to-world poses, shape :math:`(N, 4, 4)`.
        T_ec: Estimate at the same times, camera-to-world poses, shape :math:`(N, 4, 4)`.
        alignment: Alignment of the estimate to the ground truth, from `align`.

    Returns:
        Size of the ground truth divided by the size of the estimate. None if both sizes agree within a factor of
        `_MIN_SCALE_FACTOR`, or if the shapes differ (more than `_MAX_UNEXPLAINED_VARIANCE` after rescaling).
    """
    p_g, p_e = T_gc[:, :3, 3], (alignment.T_ge @ T_ec)[:, :3, 3]
    p_g, p_e = p_g - p_g.mean(dim=0), p_e - p_e.mean(dim=0)
    factor = float((p_g * p_e).sum() / p_e.square().sum())
    unexplained = (factor * p_e - p_g).square().sum() / p_g.square().sum()
    same_size = 1 / _MIN_SCALE_FACTOR < factor < _MIN_SCALE_FACTOR
    return factor if factor > 0 and not same_size and unexplained < _MAX_UNEXPLAINED_VARIANCE else None


def _nearest_rotation(M: Tensor) -> Tensor:
    """Return the rotation R that maximises trace(R^T M), shape (3, 3)."""
    U, _, Vh = torch.linalg.svd(M)
    signs = torch.ones(3, dtype=M.dtype)
    signs[2] = torch.linalg.det(U @ Vh).sign()  # exclude reflections
    return U @ torch.diag(signs) @ Vh
