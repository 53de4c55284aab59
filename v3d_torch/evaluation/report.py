"""The evaluation of one trajectory (paper, Sec. IV): ATE, RPE, and what must be known to read them."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch

from v3d_torch.errors import InputError
from v3d_torch.evaluation.ate import Alignment, RotationSource, absolute_errors, align, scale_error
from v3d_torch.evaluation.pose_association import MAX_TIME_DIFFERENCE, match
from v3d_torch.evaluation.rpe import RPE, relative_pose_error
from v3d_torch.evaluation.statistics import Statistics
from v3d_torch.types import Trajectory

MIN_PAIRS = 3
"""Poses with ground truth that an alignment needs."""


@dataclass(frozen=True)
class Evaluation:
    """Scores of an estimated trajectory.

    Attributes:
        ate: absolute trajectory error, metres.
        rpe: relative pose error; None where it cannot be measured, and ``notes`` says why.
        pairs: poses that have ground truth.
        poses: poses of the estimate.
        coverage: poses of the estimate per frame of the sequence (a system that leaves out frames looks better than it
            is); None where the number of frames was not given.
        alignment: lays the estimate on the ground truth.
        notes: what was done otherwise than usual, a sentence each.
    """

    ate: Statistics
    rpe: RPE | None
    pairs: int
    poses: int
    coverage: float | None
    alignment: Alignment
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON, nested by attribute: ``["ate"]["rmse"]``, ``["rpe"]["trans"]["rmse"]`` and so on."""
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
) -> Evaluation:
    """Score a trajectory by the protocol of the TUM RGB-D benchmark, which the paper's tables follow.

    Poses are paired one to one by nearest stamps. ATE: rigid alignment over all pairs, distance of the positions (see
    `align` for a camera that hardly moves). RPE: motions over ``rpe_delta``, without alignment.

    Args:
        groundtruth: poses of the reference.
        estimate: poses to be judged, in any world.
        max_time_difference: farther stamps are no pair, seconds.
        rpe_delta: time over which drift is measured, seconds.
        frames: colour-depth pairs of the sequence, for the coverage.

    Raises:
        InputError: fewer than three poses of the two belong together, or one of the two is no trajectory.
    """
    for what, given in (("ground truth", groundtruth), ("estimate", estimate)):
        if not isinstance(given, Trajectory):
            raise InputError(
                f"the {what} is a {type(given).__name__}; give a Trajectory: of a file by read_trajectory, or of arrays"
            )
    matches = match(groundtruth, estimate, max_time_difference)
    if len(matches) < MIN_PAIRS:
        raise InputError(
            f"only {len(matches)} poses of the estimate {_span(estimate)} lie within {max_time_difference:g} s of the "
            f"ground truth {_span(groundtruth)}, at least {MIN_PAIRS} are needed; are they of the same sequence?"
        )
    T_gc, T_ec = groundtruth.T_wc[matches.groundtruth], estimate.T_wc[matches.estimate]
    oriented = is_oriented(groundtruth)
    alignment = align(T_gc, T_ec, oriented=oriented)
    notes = []
    if alignment.source is RotationSource.ORIENTATIONS:
        notes.append("the ground truth's positions span no plane: aligned by the mean of the orientations")
    factor = scale_error(T_gc, T_ec, alignment)
    if factor is not None:
        notes.append(f"the ground truth is {factor:.3g} times as large as the estimate: is depth_scale right?")
    rpe = relative_pose_error(groundtruth, estimate, matches, rpe_delta) if oriented else None
    if not oriented:
        notes.append("the ground truth moves but all its orientations are the same, placeholders: no RPE")
    elif rpe is None:
        notes.append(f"no two poses with ground truth are {rpe_delta:g} s apart: no RPE")
    return Evaluation(
        ate=Statistics.of(absolute_errors(T_gc, T_ec, alignment)),
        rpe=rpe,
        pairs=len(matches),
        poses=len(estimate),
        coverage=len(estimate) / frames if frames else None,
        alignment=alignment,
        notes=tuple(notes),
    )


def is_oriented(trajectory: Trajectory) -> bool:
    """Whether orientations were measured: where a camera's position changes and its orientation never, they were not.

    Ground truths of which only positions are known fill the columns of the quaternion with a constant.
    """
    T_wc = trajectory.T_wc
    turns = not torch.allclose(T_wc[:, :3, :3], T_wc[:1, :3, :3], rtol=0, atol=1e-9)
    moves = not torch.allclose(T_wc[:, :3, 3], T_wc[:1, :3, 3], rtol=0, atol=1e-9)
    return turns or not moves


def _span(trajectory: Trajectory) -> str:
    if not len(trajectory):
        return "(empty)"
    return f"({trajectory.stamps[0]:.2f} to {trajectory.stamps[-1]:.2f} s)"
