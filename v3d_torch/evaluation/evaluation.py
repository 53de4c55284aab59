"""Evaluation of one trajectory (paper, Sec. IV): ATE, RPE, coverage, and notes on how they were measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from v3d_torch.errors import ConfigError, InputError
from v3d_torch.evaluation.association import MAX_TIME_DIFFERENCE, associate_trajectories
from v3d_torch.evaluation.ate import Alignment, RotationSource, absolute_errors, align, scale_error
from v3d_torch.evaluation.rpe import RPE, relative_pose_error
from v3d_torch.evaluation.statistics import Statistics
from v3d_torch.geometry.argument_checks import check_masks
from v3d_torch.types import Trajectory

MIN_PAIRS = 3
"""Minimum number of associated poses: three positions determine a rigid alignment."""

_UNITS = {10**3: "milliseconds", 10**6: "microseconds", 10**9: "nanoseconds"}
"""Units of timestamps by their number in a second."""

_MAX_PLAIN_STAMP = 1e20
"""Timestamps beyond this are printed with an exponent, seconds: nanoseconds since 1970 have 19 digits."""

_UNIT_TOLERANCE = 2.0
"""Maximum ratio of the durations of two trajectories of one sequence, of which one can be a part."""


@dataclass(frozen=True)
class Evaluation:
    """Errors of an estimated trajectory.

    Attributes:
        ate: Absolute trajectory error, metres.
        rpe: Relative pose error; None if it cannot be measured, with the reason in ``notes``.
        pairs: Number of estimated poses with ground truth.
        poses: Number of estimated poses.
        coverage: Number of estimated poses divided by the number of frames of the sequence; None if the latter is not
            known. A system that skips hard frames has smaller errors, but also a smaller coverage.
        alignment: Alignment of the estimate to the ground truth.
        notes: Deviations from the usual protocol, one sentence each.
    """

    ate: Statistics
    rpe: RPE | None
    pairs: int
    poses: int
    coverage: float | None
    alignment: Alignment
    notes: tuple[str, ...]

    @property
    def pairs_text(self) -> str:
        """Number of the poses with ground truth, in words."""
        return f"{self.pairs} of {self.poses} poses have ground truth"

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON, nested by attribute: ``["ate"]["rmse"]``, ``["rpe"]["trans"]["rmse"]`` etc."""
        return {
            "ate": asdict(self.ate),
            "rpe": asdict(self.rpe) if self.rpe is not None else None,
            "pairs": self.pairs,
            "poses": self.poses,
            "coverage": self.coverage,
            "alignment": {"rotation_from": self.alignment.source.value, "T_ge": self.alignment.T_ge.tolist()},
            "notes": list(self.notes),
        }


def evaluate(
    groundtruth: Trajectory,
    estimate: Trajectory,
    *,
    max_time_difference: float = MAX_TIME_DIFFERENCE,
    rpe_delta: float = 1.0,
    frames: int | None = None,
    is_localised: Tensor | None = None,
) -> Evaluation:
    """Evaluate a trajectory by the protocol of the TUM RGB-D benchmark, which the paper's tables follow.

    Poses are associated one to one by nearest timestamps. ATE: distances of the positions after a rigid alignment over
    all pairs (see `align` for a camera that hardly moves). RPE: errors of the motions over ``rpe_delta``, without
    alignment.

    Args:
        groundtruth: Ground-truth poses.
        estimate: Estimated poses, in any world.
        max_time_difference: Maximum difference between the timestamps of a pair, seconds, at least 0.
        rpe_delta: Time over which the RPE measures drift, seconds.
        frames: Number of colour-depth pairs of the sequence, for the coverage.
        is_localised: True for each pose of the estimate that was measured relative to the map, bool, shape
            :math:`(N,)`; None if this is not known. The other poses count for the errors, but do not indicate the
            scale of depth.

    Raises:
        InputError: If fewer than three poses can be associated, if an argument is not a trajectory, if an associated
            pose is not finite, or if ``is_localised`` is not a mask of the poses.
        ConfigError: If ``max_time_difference`` is negative or not a number, if ``rpe_delta`` is not positive, or if
            ``frames`` is negative.
    """
    _check_arguments(groundtruth, estimate, max_time_difference, frames, is_localised)
    matches = associate_trajectories(groundtruth, estimate, max_time_difference)
    if len(matches) < MIN_PAIRS:
        raise InputError(
            f"only {len(matches)} of {len(estimate)} poses of the estimate {_time_range(estimate)} are within"
            f" {max_time_difference:g} s of the ground truth {_time_range(groundtruth)}, at least"
            f" {MIN_PAIRS} are needed; {_suggest(groundtruth, estimate)}"
        )
    T_gc, T_ec = groundtruth.T_wc[matches.groundtruth], estimate.T_wc[matches.estimate]
    for name, poses in (("ground truth", T_gc), ("estimate", T_ec)):
        if not bool(poses.isfinite().all()):
            raise InputError(f"the {name} has a pose that is not finite; remove such poses")
    oriented = has_orientations(groundtruth)
    alignment = align(T_gc, T_ec, oriented=oriented)
    notes = []
    if alignment.source is RotationSource.ORIENTATIONS:
        notes.append("the ground-truth positions do not span a plane: aligned by the mean of the orientations")
    if is_localised is None or bool(is_localised[matches.estimate].all()):
        factor = scale_error(T_gc, T_ec, alignment)
    else:
        localised = is_localised[matches.estimate]
        factor = _localised_scale_error(T_gc[localised], T_ec[localised], oriented)
    if factor is not None:
        notes.append(f"the ground truth is {factor:.3g} times as large as the estimate: check depth_scale")
    rpe = relative_pose_error(groundtruth, estimate, matches, rpe_delta) if oriented else None
    if not oriented:
        notes.append("the ground truth moves but its orientations are all the same, so they are placeholders: no RPE")
    elif rpe is None:
        notes.append(f"no two poses with ground truth are {rpe_delta:g} s apart: no RPE")
    if frames is not None and len(estimate) > frames:
        notes.append(f"the trajectory has {len(estimate)} poses for {frames} frames: check the number of frames")
    return Evaluation(
        ate=Statistics.of(absolute_errors(T_gc, T_ec, alignment)),
        rpe=rpe,
        pairs=len(matches),
        poses=len(estimate),
        coverage=_coverage(len(estimate), frames),
        alignment=alignment,
        notes=tuple(notes),
    )


def _check_arguments(
    groundtruth: object,
    estimate: Trajectory,
    max_time_difference: float,
    frames: int | None,
    is_localised: Tensor | None,
) -> None:
    """Check the arguments of `evaluate`."""
    for name, value in (("ground truth", groundtruth), ("estimate", estimate)):
        if not isinstance(value, Trajectory):
            raise InputError(
                f"the {name} is a {type(value).__name__}, not a Trajectory; read a file with read_trajectory, or build"
                " a Trajectory from arrays"
            )
    check_masks(is_localised=is_localised)
    if is_localised is not None and len(is_localised) != len(estimate):
        raise InputError(
            f"is_localised has {len(is_localised)} values for {len(estimate)} poses; give one for each pose"
        )
    if not max_time_difference >= 0:  # also for NaN
        raise ConfigError(f"max_time_difference is {max_time_difference}; give a time of at least 0 seconds")
    if frames is not None and frames < 0:
        raise ConfigError(f"frames is {frames}; give the number of frames of the sequence")


def note_too_few_poses(groundtruth: Trajectory | None, poses: int) -> tuple[str, ...]:
    """Return the notes of a trajectory without scores: that it has too few poses to compare with its ground truth.

    Args:
        groundtruth: Ground-truth poses; None if there are none, without a note.
        poses: Number of estimated poses.
    """
    if groundtruth is None or poses >= MIN_PAIRS:
        return ()
    return (f"only {poses} {'pose' if poses == 1 else 'poses'}: at least {MIN_PAIRS} are needed for an ATE",)


def absent_scores(poses: int, frames: int | None, notes: Sequence[str] = ()) -> dict[str, Any]:
    """Return the values of `Evaluation.to_dict` for a trajectory that cannot be compared with a ground truth.

    Args:
        poses: Number of estimated poses.
        frames: Number of frames of the sequence; None if it is not known.
        notes: Reasons why there are no scores, one sentence each.
    """
    absent = dict.fromkeys(("ate", "rpe", "alignment"))
    return {**absent, "pairs": 0, "poses": poses, "coverage": _coverage(poses, frames), "notes": list(notes)}


def format_coverage(coverage: float) -> str:
    """Format a coverage as a percentage with one decimal, rounded down, so that 100.0% are all frames.

    Args:
        coverage: Coverage, see `Evaluation`.
    """
    thousandths = math.floor(round(1e3 * coverage, 6))  # rounded, because 0.29 has no exact value
    return f"{thousandths / 10:.1f}%"


def has_orientations(trajectory: Trajectory) -> bool:
    """Check whether the orientations of a trajectory were measured.

    A ground truth that has only positions has constant quaternions. Orientations that are constant while the position
    changes are therefore placeholders.
    """
    T_wc = trajectory.T_wc
    turns = not torch.allclose(T_wc[:, :3, :3], T_wc[:1, :3, :3], rtol=0, atol=1e-9)
    moves = not torch.allclose(T_wc[:, :3, 3], T_wc[:1, :3, 3], rtol=0, atol=1e-9)
    return turns or not moves


def _coverage(poses: int, frames: int | None) -> float | None:
    return min(poses / frames, 1.0) if frames else None


def _localised_scale_error(T_gc: Tensor, T_ec: Tensor, oriented: bool) -> float | None:
    """Compute the scale error of the poses that were measured relative to the map; None if there are too few."""
    if len(T_gc) < MIN_PAIRS:
        return None
    return scale_error(T_gc, T_ec, align(T_gc, T_ec, oriented=oriented))


def _suggest(groundtruth: Trajectory, estimate: Trajectory) -> str:
    """Return what to do if hardly any poses are associated."""
    advice = "check that both belong to the same sequence"
    if len(estimate) < MIN_PAIRS:
        return f"{advice} and that the estimate is complete"
    for name, counts, seconds in (
        ("estimate", estimate.stamps, groundtruth.stamps),
        ("ground truth", groundtruth.stamps, estimate.stamps),
    ):
        for factor, unit in _UNITS.items():
            if _is_same_time(counts / factor, seconds):
                return f"the timestamps of the {name} seem to be in {unit}, write them in seconds"
    return advice


def _is_same_time(a: Tensor, b: Tensor) -> bool:
    """Check whether timestamps (N,) and (M,) overlap and have similar durations, of which neither is 0."""
    if not len(a) or not len(b) or a[-1] < b[0] or b[-1] < a[0]:
        return False
    durations = float(a[-1] - a[0]), float(b[-1] - b[0])
    return max(durations) < _UNIT_TOLERANCE * min(durations)


def _time_range(trajectory: Trajectory) -> str:
    if not len(trajectory):
        return "(empty)"
    first, last = trajectory.stamps[0], trajectory.stamps[-1]
    digits = ".2f" if abs(last) < _MAX_PLAIN_STAMP else ".3g"
    return f"({first:{digits}} to {last:{digits}} s)"
