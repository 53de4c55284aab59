"""Depth scale from measured poses. Images alone do not determine it: a room of half the size gives the same images."""

from __future__ import annotations

from typing import NamedTuple

import torch

from v3d_torch.evaluation.association import associate_trajectories
from v3d_torch.evaluation.ate import align, spans_plane
from v3d_torch.optim.jackknife import jackknife_covariance
from v3d_torch.types import Trajectory

_MIN_PAIRS = 10
"""Minimum number of pairs of poses."""


class MetricScale(NamedTuple):
    """Scale of a measured trajectory relative to an estimated trajectory.

    Attributes:
        ratio: Ratio of the sizes.
        sigma: Its standard deviation, by the jackknife over blocks of time.
        blocks: Number of these blocks.
    """

    ratio: float
    sigma: float
    blocks: int


def metric_scale(groundtruth: Trajectory, estimate: Trajectory) -> MetricScale | None:
    """Scale of a measured trajectory relative to an estimated trajectory.

    It is the inverse of the factor by which the measured positions fit the estimated ones best. Measured positions are
    more accurate; the factor in the other direction (Umeyama, PAMI 1991) would be too small, by the variance of the
    errors of the estimated positions relative to that of the positions.

    Args:
        groundtruth: Measured poses, in metres.
        estimate: Estimated poses, in the metres of the depth images.

    Returns:
        Ratio and its standard deviation; None if the trajectories have too few common poses, if the positions of one do
        not span a plane, or if the positions are not correlated.
    """
    matches = associate_trajectories(groundtruth, estimate)
    if len(matches) < _MIN_PAIRS:
        return None
    T_gc, T_ec = groundtruth.T_wc[matches.groundtruth], estimate.T_wc[matches.estimate]
    if not (spans_plane(T_gc[:, :3, 3]) and spans_plane(T_ec[:, :3, 3])):
        return None
    aligned = align(T_gc, T_ec).T_ge @ T_ec
    measured, estimated = (T[:, :3, 3] - T[:, :3, 3].mean(dim=0) for T in (T_gc, aligned))
    squared = measured.square().sum(dim=1)
    factor = float((measured * estimated).sum() / squared.sum())
    if factor <= 0:
        return None
    gradient = -2 * (measured * (estimated - factor * measured)).sum(dim=1)
    variance, blocks = jackknife_covariance(gradient[:, None], 2 * squared[:, None, None])
    return MetricScale(1 / factor, float(torch.sqrt(variance[0, 0])) / factor**2, blocks)
