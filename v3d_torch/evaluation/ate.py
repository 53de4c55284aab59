"""Absolute trajectory error (Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import torch
from torch import Tensor

_PLANE = 1e-3
"""Metres: a ground truth whose positions spread less than this (standard deviation) in all directions but one spans no
plane. Motion capture is no more precise; the hand that holds a camera still in fr3/s/static spreads it by 12 mm."""


_SCALE = 1.5
"""A trajectory of the right shape that is larger or smaller by this did not drift: its unit is another one."""


class RotationSource(StrEnum):
    """What the rotation of an alignment was taken from."""

    POSITIONS = "positions"
    ORIENTATIONS = "orientations"


@dataclass(frozen=True)
class Alignment:
    """The rigid motion that lays an estimate on its ground truth.

    Attributes:
        T_ge: maps the estimate's world to the ground truth's, ``T_gc = T_ge @ T_ec``; float64, shape :math:`(4, 4)`.
        source: what the rotation was taken from.
    """

    T_ge: Tensor
    source: RotationSource


def spans_plane(positions: Tensor) -> bool:
    """Whether positions determine a rotation: not those of a camera that stands, only turns, or moves on a line.

    Args:
        positions: metres, shape :math:`(N, 3)`.
    """
    centred = positions - positions.mean(dim=0)
    spread = torch.linalg.eigvalsh(centred.mT @ centred / len(positions)).clamp(min=0).sqrt()  # increasing
    return bool(spread[1] > _PLANE)


def align(T_gc: Tensor, T_ec: Tensor, *, oriented: bool = True) -> Alignment:
    """Find the rigid motion, without scale, that lays the estimate on the ground truth (Umeyama, PAMI 1991).

    Least squares over the positions. Where those of the ground truth span no plane they leave the rotation open: it is
    then the mean of what the orientations say, and the centroids give the translation.

    Args:
        T_gc: ground truth, camera to its world, float64, shape :math:`(N, 4, 4)`.
        T_ec: estimate at the same times, camera to its world, float64, shape :math:`(N, 4, 4)`.
        oriented: whether the ground truth's orientations were measured.
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
    """Distance of each aligned position to the true one.

    Args:
        T_gc: ground truth, shape :math:`(N, 4, 4)`.
        T_ec: estimate at the same times, shape :math:`(N, 4, 4)`.
        alignment: of the two, from `align`.

    Returns:
        Metres, shape :math:`(N,)`.
    """
    return ((alignment.T_ge @ T_ec)[:, :3, 3] - T_gc[:, :3, 3]).norm(dim=-1)


def scale_error(T_gc: Tensor, T_ec: Tensor, alignment: Alignment) -> float | None:
    """By how much an estimate of the right shape has the wrong size, as where depth is read in wrong units.

    Args:
        T_gc: ground truth, shape :math:`(N, 4, 4)`.
        T_ec: estimate at the same times, shape :math:`(N, 4, 4)`.
        alignment: of the two, from `align`.

    Returns:
        Size of the ground truth over that of the estimate; None where that is less than `_SCALE` either way, or the
        shape is another one: the estimate in this size leaves more than half of the ground truth's spread.
    """
    p_g, p_e = T_gc[:, :3, 3], (alignment.T_ge @ T_ec)[:, :3, 3]
    p_g, p_e = p_g - p_g.mean(dim=0), p_e - p_e.mean(dim=0)
    factor = float((p_g * p_e).sum() / p_e.square().sum())
    left = (factor * p_e - p_g).square().sum() / p_g.square().sum()
    return factor if factor > 0 and not 1 / _SCALE < factor < _SCALE and left < 0.25 else None


def _nearest_rotation(M: Tensor) -> Tensor:
    """The rotation R that maximises trace(R^T M), shape (3, 3)."""
    U, _, Vh = torch.linalg.svd(M)
    signs = torch.ones(3, dtype=M.dtype)
    signs[2] = torch.linalg.det(U @ Vh).sign()  # a rotation, never a reflection
    return U @ torch.diag(signs) @ Vh
