"""Errors of the position and velocity of tracked people, against true masks, depth and ground-truth camera poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from track_evaluation.scores import FrameOverlap
from track_evaluation.truth import TruePeople
from v3d_torch.geometry.se3 import invert
from v3d_torch.geometry.voxel import voxel_pool
from v3d_torch.objects.object_state import ObjectState
from v3d_torch.types import Trajectory

_MIN_IOU = 0.5
"""Minimum intersection over union of a person and the track that is compared with it, as in most benchmarks."""

_BORDER = 2
"""A person whose mask comes this near to the border of the image is not fully in view, pixels."""

_HALF_INTERVAL = 0.25
"""The true velocity is the difference of the positions this long before and after, divided by the time, seconds."""

_PAST = 0.3
"""Time of the true positions from which a velocity is computed without later ones, seconds: with 0.2 or 0.5 s, errors
are no smaller on most sequences."""

_MAX_STAMP_DIFFERENCE = 0.02
"""Maximum difference of the stamps of a frame and its ground-truth pose, seconds."""

_VOXEL_SIZE = 0.05
"""Side of the voxels over which a true position averages, metres: near and far parts of a body count the same."""

_MAX_DEPTH_DIFFERENCE = 0.6
"""Pixels of a mask whose depth differs more from its median show something else, metres."""


@dataclass(frozen=True)
class MotionScores:
    """Errors of people who are fully in view.

    Attributes:
        position: Median error of the position, metres; NaN without people.
        velocity: Median error of the velocity, m/s; NaN if it is not known for anyone.
        velocity_from_truth: The same of the velocity that fits the true positions of the last 0.3 s best: a true
            velocity contains what happens in the next quarter of a second, which no filter knows.
        position_nees: Mean squared error of the position divided by its variance; 3 is expected.
        velocity_nees: The same of the velocity; 3 is expected.
        count: Number of positions.
    """

    position: float
    velocity: float
    velocity_from_truth: float
    position_nees: float
    velocity_nees: float
    count: int


@dataclass
class MotionErrors:
    """Collects people and their tracks frame by frame.

    Args:
        rays: Ray of each pixel at unit depth, shape (H, W, 3).
        groundtruth: Ground-truth camera-to-world poses; None if there are none, so that only positions are compared.
    """

    rays: NDArray[np.float32]
    groundtruth: Trajectory | None
    _truth: dict[int, list[tuple[float, NDArray[np.float64], bool]]] = field(default_factory=dict)
    _tracks: list[tuple[int, float, NDArray[np.float64], ObjectState]] = field(default_factory=list)

    def add(
        self, people: TruePeople, depth: Tensor, overlap: FrameOverlap, states: dict[int, ObjectState], T_wc: Tensor
    ) -> None:
        """Add a frame.

        Args:
            people: True people.
            depth: Depth, metres, shape (1, H, W).
            overlap: Overlap of people and tracks.
            states: State of each track.
            T_wc: Estimated camera-to-world pose.
        """
        for number, person in enumerate(people.ids):
            mask = people.owner == number + 1
            position = _true_position(mask, depth[0].numpy(), self.rays)
            if position is None:
                continue
            inner = mask[_BORDER:-_BORDER, _BORDER:-_BORDER]
            self._truth.setdefault(person, []).append((people.stamp, position, inner.sum() == mask.sum()))
            if overlap.iou.shape[1] and overlap.iou[number].max() >= _MIN_IOU:
                track = overlap.tracks[int(overlap.iou[number].argmax())]
                if states[track].is_known:
                    self._tracks.append((person, people.stamp, invert(T_wc).numpy(), states[track]))

    def scores(self) -> MotionScores:
        """Return the errors of all frames."""
        positions, velocities, from_truth, position_nees, velocity_nees = [], [], [], [], []
        for person, stamp, T_cw, state in self._tracks:
            seen = {t: (position, whole) for t, position, whole in self._truth[person]}
            true, whole = seen[stamp]
            if not whole:
                continue
            error = T_cw[:3, :3] @ state.position.numpy() + T_cw[:3, 3] - true
            positions.append(np.linalg.norm(error))
            position_nees.append(error @ error / state.variances[0])
            velocity = self._true_velocity(person, stamp)
            if velocity is not None:
                error = T_cw[:3, :3] @ state.velocity.numpy() - velocity
                velocities.append(np.linalg.norm(error))
                velocity_nees.append(error @ error / state.variances[2])
                from_truth.append(np.linalg.norm(self._velocity_from_past(person, stamp) - velocity))
        return MotionScores(
            position=_median(positions),
            velocity=_median(velocities),
            velocity_from_truth=_median(from_truth),
            position_nees=_mean(position_nees),
            velocity_nees=_mean(velocity_nees),
            count=len(positions),
        )

    def _true_velocity(self, person: int, stamp: float) -> NDArray[np.float64] | None:
        """Velocity in the camera frame of the stamp; None if the person is not fully in view before and after."""
        ends = []
        for wanted in (stamp - _HALF_INTERVAL, stamp + _HALF_INTERVAL):
            t, position, whole = min(self._truth[person], key=lambda seen: abs(seen[0] - wanted))
            T_wc = self._pose(t)
            if not whole or abs(t - wanted) > _HALF_INTERVAL / 2 or T_wc is None:
                return None
            ends.append((t, T_wc[:3, :3] @ position + T_wc[:3, 3]))
        T_wc = self._pose(stamp)
        (t0, p0), (t1, p1) = ends
        return None if T_wc is None else T_wc[:3, :3].T @ (p1 - p0) / (t1 - t0)

    def _velocity_from_past(self, person: int, stamp: float) -> NDArray[np.float64]:
        """Slope of the line that fits the true positions up to a stamp best, in the camera frame of the stamp.

        NaN if the person was not fully in view twice in this time.
        """
        past = [
            (t, T_wc[:3, :3] @ position + T_wc[:3, 3])
            for t, position, whole in self._truth[person]
            if whole and -_PAST <= t - stamp <= 0 and (T_wc := self._pose(t)) is not None
        ]
        T_wc = self._pose(stamp)
        if len(past) < 2 or T_wc is None:
            return np.full(3, np.nan)
        stamps, positions = np.array([t for t, _ in past]), np.stack([position for _, position in past])
        return np.asarray(T_wc[:3, :3].T @ np.polyfit(stamps - stamp, positions, 1)[0])

    def _pose(self, stamp: float) -> NDArray[np.float64] | None:
        """Ground-truth pose at a stamp, (4, 4)."""
        if self.groundtruth is None:
            return None
        difference = (self.groundtruth.stamps - stamp).abs()
        nearest = int(difference.argmin())
        return self.groundtruth.T_wc[nearest].numpy() if difference[nearest] <= _MAX_STAMP_DIFFERENCE else None


def _median(values: Sequence[float]) -> float:
    """Median of the values that are known; NaN without any."""
    return float(np.nanmedian(values)) if np.isfinite(values).any() else np.nan


def _mean(values: Sequence[float]) -> float:
    """Mean; NaN without values."""
    return float(np.mean(values)) if values else np.nan


def _true_position(
    mask: NDArray[np.bool_], depth: NDArray[np.float32], rays: NDArray[np.float32]
) -> NDArray[np.float64] | None:
    """Mean of the voxels of a person's visible surface, camera frame, metres; None without depth."""
    inside = mask & (depth > 0)
    if not inside.any():
        return None
    z = depth[inside]
    near = np.abs(z - np.median(z)) < _MAX_DEPTH_DIFFERENCE
    points = torch.from_numpy((rays[inside] * z[:, None])[near].astype(np.float64))[None]
    voxels = voxel_pool(points, torch.ones(points.shape[:2], dtype=torch.bool), _VOXEL_SIZE)
    return np.asarray(voxels.means[0].mean(dim=0).numpy())


def format_scores(scores: MotionScores) -> dict[str, str]:
    """Return the cells of a table."""
    return {
        "position": f"{100 * scores.position:.1f}",
        "velocity": f"{scores.velocity:.2f}",
        "velocity_from_truth": f"{scores.velocity_from_truth:.2f}",
        "nees": f"{scores.position_nees:.1f}, {scores.velocity_nees:.1f}",
        "positions": str(scores.count),
    }
