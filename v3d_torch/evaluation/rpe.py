"""Relative pose error: drift over a fixed time (Sturm et al., IROS 2012; the paper's Tables II and III)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.evaluation.pose_association import Matches
from v3d_torch.evaluation.statistics import Statistics
from v3d_torch.geometry.se3 import invert, se3_log
from v3d_torch.types import Trajectory


@dataclass(frozen=True)
class RPE:
    """Drift of an estimate.

    Attributes:
        trans: metres per ``delta``; over one second this is m/s.
        rot: degrees per ``delta``; over one second this is deg/s.
        pairs: how many pairs of poses it was measured on.
        delta: time between the poses of a pair, seconds.
    """

    trans: Statistics
    rot: Statistics
    pairs: int
    delta: float


@dataclass(frozen=True)
class Drift:
    """Error of each motion over a fixed time.

    Attributes:
        first: index of the pose of the estimate where the motion begins, increasing, int64, shape :math:`(P,)`.
        trans: metres, shape :math:`(P,)`.
        rot: degrees, shape :math:`(P,)`.
    """

    first: Tensor
    trans: Tensor
    rot: Tensor


def relative_pose_error(
    groundtruth: Trajectory, estimate: Trajectory, matches: Matches, delta: float = 1.0
) -> RPE | None:
    """Compare motions over ``delta`` seconds, as the TUM benchmark's ``evaluate_rpe.py --fixed_delta`` does.

    Args:
        groundtruth: poses of the reference.
        estimate: poses to be judged.
        matches: of the two.
        delta: seconds between the poses of a pair.

    Returns:
        None when no two matched poses are so far apart.
    """
    errors = drift(groundtruth, estimate, matches, delta)
    pairs = len(errors.first)
    return RPE(Statistics.of(errors.trans), Statistics.of(errors.rot), pairs, delta) if pairs else None


def drift(groundtruth: Trajectory, estimate: Trajectory, matches: Matches, delta: float = 1.0) -> Drift:
    """The single errors that `relative_pose_error` summarises; its arguments."""
    truth = torch.full((len(estimate),), -1, dtype=torch.int64)
    truth[matches.estimate] = matches.groundtruth
    first, second = pairs_apart(estimate.stamps, delta)
    known = (truth[first] >= 0) & (truth[second] >= 0)
    first, second = first[known], second[known]
    trans, rot = relative_errors(
        groundtruth.T_wc[truth[first]], groundtruth.T_wc[truth[second]], estimate.T_wc[first], estimate.T_wc[second]
    )
    return Drift(first, trans, rot)


def pairs_apart(stamps: Tensor, delta: float) -> tuple[Tensor, Tensor]:
    """For each pose the one that is nearest to ``delta`` seconds later.

    Poses for which that is the very last one are left out, as in the benchmark's tool (the time ``delta`` later is past
    the end for most of them), and so are those with a gap there: nothing within half of ``delta``.

    Args:
        stamps: seconds, increasing, float64, shape :math:`(N,)`.
        delta: seconds.

    Returns:
        Indices of the first and of the second poses, int64, shape :math:`(P,)` each.
    """
    last = len(stamps) - 1
    after = torch.searchsorted(stamps, stamps + delta).clamp(max=last)
    before = (after - 1).clamp(min=0)
    later = stamps + delta
    second = torch.where(later - stamps[before] <= stamps[after] - later, before, after)
    apart = (second != last) & ((stamps[second] - later).abs() <= delta / 2)
    return apart.nonzero()[:, 0], second[apart]


def relative_errors(T_gi: Tensor, T_gj: Tensor, T_ei: Tensor, T_ej: Tensor) -> tuple[Tensor, Tensor]:
    r"""Error of the estimated motions from times i to times j.

    :math:`E = (T_{ei}^{-1} T_{ej}) (T_{gi}^{-1} T_{gj})^{-1}`, the order of the benchmark's tool and so of the
    published tables. (Its paper, and evo, put the inverse on the left: the angles are the same, the lengths differ a
    little, 0.0726 against 0.0721 m for V3D-SLAM on fr3/w/rpy.)

    Args:
        T_gi: ground truth at i, camera to world, shape :math:`(P, 4, 4)`; so the others.
        T_gj: ground truth at j.
        T_ei: estimate at i, in any world.
        T_ej: estimate at j, in the same world.

    Returns:
        Length of the translation in metres and angle of the rotation in degrees, shape :math:`(P,)` each.
    """
    E = (invert(T_ei) @ T_ej) @ invert(invert(T_gi) @ T_gj)
    return E[:, :3, 3].norm(dim=-1), torch.rad2deg(se3_log(E)[:, 3:].norm(dim=-1))
