"""Poses of all frames, stored relative to keyframes, so that they follow corrections of the map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from v3d_torch.geometry.se3 import interpolate, invert, orthonormalise
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.odometry.odometry import CameraMotion
from v3d_torch.types import FramePose, TrackingStatus, Trajectory


@dataclass(frozen=True)
class PoseEntry:
    """Pose of one frame.

    Attributes:
        stamp: Timestamp, seconds.
        status: Source of the pose.
        keyframe: Keyframe to which the pose is relative; None for the world frame, before the first keyframe.
        T_ck: Motion from the keyframe to the camera, float64, shape :math:`(4, 4)`.
        has_motion: True if the motion since the previous frame was measured.
    """

    stamp: float
    status: TrackingStatus
    keyframe: Keyframe | None
    T_ck: Tensor
    has_motion: bool

    @property
    def T_cw(self) -> Tensor:
        """World-to-camera pose in the current map, float64, shape :math:`(4, 4)`."""
        return self.T_ck @ _pose(self.keyframe)


class PoseHistory:
    """Poses of all frames in the order of time.

    Attributes:
        last_localised: Time of the last frame that was found, seconds; minus infinity if there is none.
        observed_landmarks: IDs of the landmarks observed by the last frame that was found, int64, shape :math:`(L,)`.
    """

    def __init__(self) -> None:
        self._entries: list[PoseEntry] = []
        self.last_localised = -torch.inf
        self.observed_landmarks = torch.zeros(0, dtype=torch.int64)
        self._place: Keyframe | None = None  # nearest to the last frame that was found

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._entries)

    @property
    def statuses(self) -> list[TrackingStatus]:
        """Statuses of all frames."""
        return [entry.status for entry in self._entries]

    @property
    def status(self) -> TrackingStatus | None:
        """Status of the last frame; None before the first."""
        return self._entries[-1].status if self._entries else None

    @property
    def stamp(self) -> float:
        """Time of the last frame, seconds; minus infinity before the first."""
        return self._entries[-1].stamp if self._entries else -torch.inf

    @property
    def T_cw(self) -> Tensor:
        """World-to-camera pose of the last frame, float64, shape :math:`(4, 4)`; the identity before the first."""
        return self._entries[-1].T_cw if self._entries else torch.eye(4, dtype=torch.float64)

    @property
    def keyframe(self) -> Keyframe | None:
        """Keyframe to which the pose of the last frame is relative; None if there is none."""
        return self._entries[-1].keyframe if self._entries else None

    @property
    def part(self) -> int:
        """ID of the part of the map in which the camera was last found, see `Keyframe`; 0 if it was not found."""
        return 0 if self._place is None else self._place.part

    @property
    def has_motion(self) -> bool:
        """True if the motion between the last frame and the one before it was measured."""
        return bool(self._entries) and self._entries[-1].has_motion

    @property
    def is_localised(self) -> bool:
        """True if any frame was found so far."""
        return self.last_localised > -torch.inf

    def append(
        self, stamp: float, pose: FramePose, motion: CameraMotion, reference: Keyframe | None, new: Keyframe | None
    ) -> Tensor | None:
        """Append the pose of a frame.

        When the camera is found again, the lost frames before it get poses from the measured motions. When it is found
        for the first time, all earlier frames are moved, because their world frame was a guess.

        Args:
            stamp: Timestamp, seconds.
            pose: Estimated pose.
            motion: Motion of the camera since the previous frame.
            reference: Keyframe relative to which the pose is stored; None before the first keyframe.
            new: Keyframe created from this frame; None if the frame is not a keyframe.

        Returns:
            If the camera was found for the first time, the transform ``T_new_old`` from the guessed world frame to that
            of the map, float64, shape :math:`(4, 4)`; else None.
        """
        status = pose.status
        if status is TrackingStatus.TRACKED and reference is not None and reference.disconnected:
            status = TrackingStatus.DISCONNECTED
        T_new_old = None
        if self.status is TrackingStatus.LOST and status is not TrackingStatus.LOST:
            correction = orthonormalise(invert(pose.T_cw) @ (motion.T_cp @ self.T_cw))
            first = not self.is_localised
            self._correct_lost(correction, reference, motion.is_measured, move_all=first)
            T_new_old = correction if first else None
        if new is None:
            entry = PoseEntry(stamp, status, reference, _relative(pose.T_cw, reference), motion.is_measured)
            if pose.count:
                self.observed_landmarks, self._place = pose.observed_landmarks, reference
        else:
            if new.disconnected:
                status = TrackingStatus.DISCONNECTED
            elif status is TrackingStatus.LOST:
                status = TrackingStatus.TRACKED  # the first keyframe of the map
            entry = PoseEntry(stamp, status, new, torch.eye(4, dtype=torch.float64), motion.is_measured)
            self.observed_landmarks, self._place = new.observed_landmarks, new
        self._entries.append(entry)
        if status is not TrackingStatus.LOST:
            self.last_localised = stamp
        return T_new_old

    def replace_last(self, T_cw: Tensor) -> None:
        """Replace the pose of the last frame by a refined world-to-camera pose, float64, shape :math:`(4, 4)`."""
        last = self._entries[-1]
        self._entries[-1] = replace(last, T_ck=_relative(T_cw, last.keyframe))

    def poses_of(self, frames: Sequence[int]) -> Tensor:
        """World-to-camera poses of some frames in the current map.

        Args:
            frames: Positions of the frames in the history, from 0.

        Returns:
            Poses, float64, shape :math:`(N, 4, 4)`.
        """
        entries = [self._entries[frame] for frame in frames]
        none = torch.zeros(0, 4, 4, dtype=torch.float64)
        T_ck, T_kw = [entry.T_ck[None] for entry in entries], [_pose(entry.keyframe)[None] for entry in entries]
        return torch.cat([none, *T_ck]) @ torch.cat([none, *T_kw])

    def trajectory(self) -> Trajectory:
        """Poses of all frames in the current map; poses of lost frames are interpolated between found frames."""
        stamps = torch.tensor([entry.stamp for entry in self._entries], dtype=torch.float64)
        T_cw = torch.cat([torch.zeros(0, 4, 4, dtype=torch.float64), *(entry.T_cw[None] for entry in self._entries)])
        found = torch.tensor([entry.status is not TrackingStatus.LOST for entry in self._entries])
        return Trajectory(stamps, invert(_interpolate(stamps, T_cw, found)))

    def state_dict(self) -> dict[str, Any]:
        """Return the poses of all frames."""
        return {
            "entries": self._entries,
            "last_localised": self.last_localised,
            "observed_landmarks": self.observed_landmarks,
            "place": self._place,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the poses of `state_dict`."""
        self._entries, self.last_localised = list(state["entries"]), state["last_localised"]
        self.observed_landmarks, self._place = state["observed_landmarks"], state["place"]

    def _correct_lost(self, T_new_old: Tensor, keyframe: Keyframe | None, linked: bool, *, move_all: bool) -> None:
        """Move the lost frames at the end of the history: all, or those that measured motions link to the new frame."""
        disconnected = keyframe is not None and keyframe.disconnected
        found = TrackingStatus.DISCONNECTED if disconnected else TrackingStatus.ODOMETRY
        for index in reversed(range(len(self._entries))):
            entry = self._entries[index]
            if entry.status is not TrackingStatus.LOST or not (linked or move_all):
                break
            T_ck = _relative(entry.T_cw @ invert(T_new_old), keyframe)
            status = found if linked else TrackingStatus.LOST
            self._entries[index] = replace(entry, status=status, keyframe=keyframe, T_ck=T_ck)
            linked = linked and entry.has_motion


def _pose(keyframe: Keyframe | None) -> Tensor:
    """Return the world-to-camera pose of a keyframe; the identity if there is none."""
    return torch.eye(4, dtype=torch.float64) if keyframe is None else keyframe.T_cw


def _relative(T_cw: Tensor, keyframe: Keyframe | None) -> Tensor:
    """Return a pose relative to a keyframe, keyframe to camera, float64, shape :math:`(4, 4)`."""
    return orthonormalise(T_cw @ invert(_pose(keyframe)))


def _interpolate(stamps: Tensor, T: Tensor, found: Tensor) -> Tensor:
    """Interpolate lost poses along the geodesic between the nearest found poses; lost poses at the ends stay."""
    known = torch.nonzero(found)[:, 0]
    if known.shape[0] == 0:
        return T
    after = torch.searchsorted(known, torch.arange(stamps.shape[0]))
    between = torch.nonzero(~found & (after > 0) & (after < known.shape[0]))[:, 0]
    a, b = known[after[between] - 1], known[after[between].clamp(max=known.shape[0] - 1)]
    fraction = (stamps[between] - stamps[a]) / (stamps[b] - stamps[a])
    T = T.clone()
    T[between] = interpolate(T[a], T[b], fraction)
    return T
