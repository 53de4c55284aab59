"""Relative pose error: drift over a fixed time (Sturm et al., IROS 2012; the paper's Tables II and III)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.errors import InputError
from v3d_torch.evaluation.association import Matches
from v3d_torch.evaluation.ate import root_mean_square
from v3d_torch.evaluation.statistics import Statistics
from v3d_torch.geometry.argument_checks import check_masks, check_positive
from v3d_torch.geometry.precision import result_dtype
from v3d_torch.geometry.se3 import invert, se3_log
from v3d_torch.geometry.settings_module import SettingsModule
from v3d_torch.kernels.compiler import can_read
from v3d_torch.runtime.batches import check_shapes, mask_or_all
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


def rpe(
    T_gc: Tensor, T_ec: Tensor, stamps: Tensor, valid: Tensor | None = None, *, delta: float = 1.0
) -> tuple[Tensor, Tensor]:
    r"""Relative pose error: root mean square error of the motions over a fixed time.

    .. math::
        E_i = \left( T_{ei}^{-1} T_{ej} \right) \left( T_{gi}^{-1} T_{gj} \right)^{-1}

    for the pose j nearest to ``delta`` after pose i. Pairs that span a gap, or end in the last pose, do not count, as
    in the benchmark's tool. Differentiable in both trajectories.

    Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012.

    Args:
        T_gc: Ground truth, camera-to-world poses, floating point, shape :math:`(*, N, 4, 4)`; converted to float64.
        T_ec: Estimate at the same times, camera-to-world poses in any world, shape :math:`(*, N, 4, 4)`.
        stamps: Timestamps, seconds, strictly increasing, shape :math:`(*, N)`; the frame numbers for a ``delta`` in
            frames.
        valid: Mask of the poses that are not padding, bool, shape :math:`(*, N)`; None for all.
        delta: Time between the poses of a pair, seconds.

    Returns:
        Translation error, metres per ``delta``, and rotation error, degrees per ``delta``, dtype of ``T_ec``, float32
        for integers, shape :math:`(*)` each; NaN if there is no pair.

    Raises:
        InputError: If ``valid`` is not bool, or the stamps do not increase.
        ConfigError: If ``delta`` is not positive.
    """
    check_masks(valid=valid)
    batch = check_shapes(T_gc=(T_gc, "N", 4, 4), T_ec=(T_ec, "N", 4, 4), stamps=(stamps, "N"), valid=(valid, "N"))
    exists = mask_or_all(valid, stamps).expand(*batch, -1)
    order = torch.argsort(~exists, dim=-1, stable=True)  # padding last
    times = torch.where(exists, stamps.to(torch.float64), torch.inf).gather(-1, order)
    _check_increasing(times)
    second, is_pair = find_later(times, exists.sum(dim=-1), delta)
    identity = torch.eye(4, dtype=torch.float64, device=T_gc.device)
    truth, estimate = (
        _take_poses(torch.where(exists[..., None, None], T.to(torch.float64), identity), order) for T in (T_gc, T_ec)
    )
    errors = relative_errors(truth, _take_poses(truth, second), estimate, _take_poses(estimate, second))
    trans, rot = (root_mean_square(each, is_pair).to(result_dtype(T_ec.dtype)) for each in errors)
    return trans, rot


def _check_increasing(times: Tensor) -> None:
    """Check that times, with infinite padding at the end, increase, if they can be read at once."""
    if can_read(times) and not bool(((times[..., 1:] > times[..., :-1]) | times[..., 1:].isinf()).all()):
        raise InputError(
            "stamps do not increase; sort the poses by time, and give each time once and in float64, because float32"
            " rounds Unix times to two minutes"
        )


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

    Raises:
        ConfigError: If ``delta`` is not positive.
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
    """Pair each pose with the pose nearest to ``delta`` seconds later; see `find_later`.

    Args:
        stamps: Timestamps, seconds, increasing, float64, shape :math:`(N,)`.
        delta: Time between the poses of a pair, seconds.

    Returns:
        Indices of the first and of the second poses, int64, shape :math:`(P,)` each.
    """
    second, is_pair = find_later(stamps, torch.tensor(len(stamps)), delta)
    return is_pair.nonzero()[:, 0], second[is_pair]


def find_later(stamps: Tensor, count: Tensor, delta: float) -> tuple[Tensor, Tensor]:
    """Find the pose nearest to ``delta`` seconds after each pose.

    As in the TUM benchmark's tool, a pair that ends in the last pose is dropped, because for most such pairs the time
    ``delta`` later is past the end. A pair is also dropped if its time difference deviates from ``delta`` by more than
    half of ``delta``, because then it spans a gap.

    Args:
        stamps: Timestamps, seconds, increasing, float64, shape :math:`(..., N)`; those of padding, at the end, are
            infinite.
        count: Number of poses that are not padding, int64, shape :math:`(...)`.
        delta: Time between the poses of a pair, seconds.

    Returns:
        Index of the later pose, int64, and a mask of the poses that have one, bool, both of shape :math:`(..., N)`.

    Raises:
        ConfigError: If ``delta`` is not positive.
    """
    check_positive(delta=delta)
    last = (count - 1).clamp(min=0)[..., None]
    later = stamps + delta
    after = torch.minimum(torch.searchsorted(stamps.contiguous(), later.contiguous()), last)
    before = (after - 1).clamp(min=0)
    at_before, at_after = stamps.gather(-1, before), stamps.gather(-1, after)
    second = torch.where(later - at_before <= at_after - later, before, after)
    index = torch.arange(stamps.shape[-1], device=stamps.device)
    is_later = second > index  # false if the stamps are so large that adding delta does not change them
    is_near = (stamps.gather(-1, second) - later).abs() <= delta / 2
    return second, (index < count[..., None]) & is_later & (second != last) & is_near


def _take_poses(T: Tensor, index: Tensor) -> Tensor:
    """Poses (..., N, 4, 4) at indices (..., N)."""
    return torch.take_along_dim(T, index[..., None, None], dim=-3)


def relative_errors(T_gi: Tensor, T_gj: Tensor, T_ei: Tensor, T_ej: Tensor) -> tuple[Tensor, Tensor]:
    r"""Compute the errors of the estimated motions from times i to times j.

    :math:`E = (T_{ei}^{-1} T_{ej}) (T_{gi}^{-1} T_{gj})^{-1}`, the order used by the benchmark's tool, and so by the
    published tables. The benchmark's paper and evo put the inverse on the left: the angles are the same, the lengths
    differ slightly.

    Args:
        T_gi: Ground truth at times i, camera-to-world poses, shape :math:`(..., P, 4, 4)`.
        T_gj: Ground truth at times j, camera-to-world poses, shape :math:`(..., P, 4, 4)`.
        T_ei: Estimate at times i, camera-to-world poses in any world, shape :math:`(..., P, 4, 4)`.
        T_ej: Estimate at times j, camera-to-world poses in the same world, shape :math:`(..., P, 4, 4)`.

    Returns:
        Translation errors in metres and rotation errors in degrees, shape :math:`(..., P)` each.
    """
    E = (invert(T_ei) @ T_ej) @ invert(invert(T_gi) @ T_gj)
    return E[..., :3, 3].norm(dim=-1), torch.rad2deg(se3_log(E)[..., 3:].norm(dim=-1))


class RelativePoseError(SettingsModule):
    """:func:`rpe` as a module.

    Args:
        delta: Time between the poses of a pair, seconds.

    Raises:
        ConfigError: If a number is not possible; see :func:`rpe`.
    """

    def __init__(self, delta: float = 1.0) -> None:
        check_positive(delta=delta)
        super().__init__()
        self.delta = delta

    def forward(self, T_gc: Tensor, T_ec: Tensor, stamps: Tensor, valid: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the errors of trajectories :math:`(*, N, 4, 4)`, metres and degrees; see :func:`rpe`."""
        return rpe(T_gc, T_ec, stamps, valid, delta=self.delta)
