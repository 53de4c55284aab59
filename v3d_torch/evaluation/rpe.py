"""Relative pose error: drift over a fixed time (Sturm et al., IROS 2012; the paper's Tables II and III)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.evaluation.association import Matches
from v3d_torch.evaluation.statistics import Statistics
from v3d_torch.geometry.se3 import invert, se3_log
from v3d_torch.types import Trajectory


@dataclass(frozen=True)
class RPE:
    """Relative pose error of an estimate.

    Attributes:
        trans: Translation error, metres per ``delta``; m/s if ``delta`` is one second.
        rot: Rotation error, degrees per ``delta``; deg/s if ``delta`` is one second.
        pairs: Number of pose pairs.
        delta: Time between the poses of a pair, seconds.
    """

    trans: Statistics
    rot: Statistics
    pairs: int
    delta: float


@dataclass(frozen=True)
class RelativeErrors:
    """Error of each motion over a fixed time.

    Attributes:
        first: Index of the estimated pose at which the motion begins, increasing, int64, shape :math:`(P,)`.
        trans: Translation errors, metres, shape :math:`(P,)`.
        rot: Rotation errors, degrees, shape :math:`(P,)`.
    """

    first: Tensor
    trans: Tensor
    rot: Tensor


def relative_pose_error(
    groundtruth: Trajectory, estimate: Trajectory, matches: Matches, delta: float = 1.0
) -> RPE | None:
    """Compute the RPE over ``delta`` seconds, as the TUM benchmark's ``evaluate_rpe.py --fixed_delta`` does.

    Args:
        groundtruth: Ground-truth poses.
        estimate: Estimated poses.
        matches: Associated poses of the two.
        delta: Time between the poses of a pair, seconds.

    Returns:
        The RPE; None if no two associated poses are ``delta`` apart.
    """
    errors = motion_errors(groundtruth, estimate, matches, delta)
    pairs = len(errors.first)
    return RPE(Statistics.of(errors.trans), Statistics.of(errors.rot), pairs, delta) if pairs else None


def motion_errors(
    groundtruth: Trajectory, estimate: Trajectory, matches: Matches, delta: float = 1.0
) -> RelativeErrors:
    """Compute the single errors summarised by `relative_pose_error`, from the same arguments."""
    truth = torch.full((len(estimate),), -1, dtype=torch.int64)
    truth[matches.estimate] = matches.groundtruth
    first, second = pairs_apart(estimate.stamps, delta)
    has_truth = (truth[first] >= 0) & (truth[second] >= 0)
    first, second = first[has_truth], second[has_truth]
    trans, rot = relative_errors(
        groundtruth.T_wc[truth[first]], groundtruth.T_wc[truth[second]], estimate.T_wc[first], estimate.T_wc[second]
    )
    return RelativeErrors(first, trans, rot)


def pairs_apart(stamps: Tensor, delta: float) -> tuple[Tensor, Tensor]:
    """Pair each pose with the pose nearest to ``delta`` seconds later.

    As in the TUM benchmark's tool, a pair that ends in the last pose is dropped, because for most such pairs the time
    ``delta`` later is past the end. A pair is also dropped if its time difference deviates from ``delta`` by more than
    half of ``delta``, because then it spans a gap.

    Args:
        stamps: Timestamps, seconds, increasing, float64, shape :math:`(N,)`.
        delta: Time between the poses of a pair, seconds.

    Returns:
        Indices of the first and of the second poses, int64, shape :math:`(P,)` each.
    """
    last = len(stamps) - 1
    after = torch.searchsorted(stamps, stamps + delta).clamp(max=last)
    before = (after - 1).clamp(min=0)
    later = stamps + delta
    second = torch.where(later - stamps[before] <= stamps[after] - later, before, after)
    valid = (second != last) & ((stamps[second] - later).abs() <= delta / 2)
    return valid.nonzero()[:, 0], second[valid]


def relative_errors(T_gi: Tensor, T_gj: Tensor, T_ei: Tensor, T_ej: Tensor) -> tuple[Tensor, Tensor]:
    r"""Compute the errors of the estimated motions from times i to times j.

    :math:`E = (T_{ei}^{-1} T_{ej}) (T_{gi}^{-1} T_{gj})^{-1}`, the order used by the benchmark's tool, and so by the
    published tables. The benchmark's paper and evo put the inverse on the left: the angles are the same, the lengths
    differ slightly.

    Args:
        T_gi: Ground truth at times i, camera-to-world poses, shape :math:`(P, 4, 4)`.
        T_gj: Ground truth at times j, camera-to-world poses, shape :math:`(P, 4, 4)`.
        T_ei: Estimate at times i, camera-to-world poses in any world, shape :math:`(P, 4, 4)`.
        T_ej: Estimate at times j, camera-to-world poses in the same world, shape :math:`(P, 4, 4)`.

    Returns:
        Translation errors in metres and rotation errors in degrees, shape :math:`(P,)` each.
    """
    E = (invert(T_ei) @ T_ej) @ invert(invert(T_gi) @ T_gj)
    return E[:, :3, 3].norm(dim=-1), torch.rad2deg(se3_log(E)[:, 3:].norm(dim=-1))
