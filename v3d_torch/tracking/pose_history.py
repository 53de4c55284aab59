"""Poses of all frames, stored relative to keyframes, so that they follow corrections of the map."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from v3d_torch.geometry.se3 import interpolate, invert, orthonormalise
from v3d_torch.mapping.keyframe import Keyframe, stack_poses
from v3d_torch.odometry.odometry import CameraMotion
from v3d_torch.runtime.stateful import StatefulComponent
from v3d_torch.runtime.tensor_table import TensorTable
from v3d_torch.types import TRACKING_STATUSES, FramePose, TrackingStatus, Trajectory


class PoseHistory(StatefulComponent):
    """Poses of all frames in the order of time.

    Attributes:
        last_found: Time of the last frame that was found, seconds; minus infinity if there is none.
        observed_landmarks: Ids of the landmarks of the last frame that observed landmarks, int64, shape :math:`(L,)`.
    """

    _STATE = ("_frames", "_keyframes", "last_found", "observed_landmarks", "_place")

    def __init__(self) -> None:
        self._frames = TensorTable(
            stamp=((), torch.float64),
            status=((), torch.int64),  # in TRACKING_STATUSES; never DISCONNECTED, which depends on the keyframe
            keyframe=((), torch.int64),  # index of the keyframe; -1 for the world frame, before the first keyframe
            T_ck=((4, 4), torch.float64),  # motion from the keyframe to the camera
            is_motion_measured=((), torch.bool),  # true if the motion since the previous frame was measured
        )
        self._keyframes: dict[int, Keyframe] = {}  # those to which poses are relative, by index
        self.last_found = -torch.inf
        self.observed_landmarks = torch.zeros(0, dtype=torch.int64)
        self._place: Keyframe | None = None  # keyframe of the last frame that observed landmarks

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._frames)

    @property
    def statuses(self) -> list[TrackingStatus]:
        """Statuses of all frames as they are known now."""
        rows = zip(self._frames["status"].tolist(), self._frames["keyframe"].tolist(), strict=True)
        return [self._current_status(code, keyframe) for code, keyframe in rows]

    @property
    def localised(self) -> Tensor:
        """Mask of the frames with `TrackingStatus.is_localised`, bool, shape :math:`(N,)`."""
        return torch.tensor([status.is_localised for status in self.statuses], dtype=torch.bool)

    @property
    def status(self) -> TrackingStatus | None:
        """Status of the last frame as it is known now; None before the first."""
        if not len(self):
            return None
        return self._current_status(int(self._frames["status"][-1]), int(self._frames["keyframe"][-1]))

    @property
    def stamp(self) -> float:
        """Time of the last frame, seconds; minus infinity before the first."""
        return float(self._frames["stamp"][-1]) if len(self) else -torch.inf

    @property
    def T_cw(self) -> Tensor:
        """World-to-camera pose of the last frame, float64, shape :math:`(4, 4)`; the identity before the first."""
        return self._pose_of(-1) if len(self) else torch.eye(4, dtype=torch.float64)

    @property
    def keyframe(self) -> Keyframe | None:
        """Keyframe to which the pose of the last frame is relative; None if there is none."""
        return self._keyframe_of(-1) if len(self) else None

    @property
    def is_localised(self) -> bool:
        """True if the pose of the last frame is known relative to the whole map; False before the first."""
        return self.status is not None and self.status.is_localised

    @property
    def part(self) -> int:
        """Id of the part of the map in which the camera was last found, see `Keyframe`; 0 if it was not found."""
        return 0 if self._place is None else self._place.part

    @property
    def is_motion_measured(self) -> bool:
        """True if the motion between the last frame and the one before it was measured."""
        return bool(len(self) and self._frames["is_motion_measured"][-1])

    @property
    def was_found(self) -> bool:
        """True if any frame was found so far."""
        return self.last_found > -torch.inf

    def append(
        self, stamp: float, pose: FramePose, motion: CameraMotion, reference: Keyframe | None, new: Keyframe | None
    ) -> Tensor | None:
        """Append the pose of a frame.

        When the camera is found again, or starts a part of the map, the lost frames before get poses from the measured
        motions. When the camera is found for the first time, all earlier frames are moved, because their world frame
        was a guess.

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
        keyframe = reference if new is None else new
        is_found = pose.status is not TrackingStatus.LOST
        status = TrackingStatus.TRACKED if new is not None and not is_found else pose.status  # it starts a part
        T_new_old = None
        if self.status is TrackingStatus.LOST and status is not TrackingStatus.LOST:
            correction = torch.eye(4, dtype=torch.float64)  # a new part of the map starts at the predicted pose
            if is_found:
                correction = orthonormalise(invert(pose.T_cw) @ (motion.T_cp @ self.T_cw))
            first = is_found and not self.was_found
            self._correct_lost(correction, keyframe, motion.is_measured, move_all=first)
            T_new_old = correction if first else None
        if new is None:
            T_ck = _relative(pose.T_cw, reference)
            if pose.landmark_count:
                self.observed_landmarks, self._place = pose.observed_landmarks, reference
        else:
            T_ck = torch.eye(4, dtype=torch.float64)
            self.observed_landmarks, self._place = new.observed_landmarks, new
        self._frames.append(
            stamp=torch.tensor([stamp], dtype=torch.float64),
            status=torch.tensor([TRACKING_STATUSES.index(status)]),
            keyframe=torch.tensor([self._add_keyframe(keyframe)]),
            T_ck=T_ck[None],
            is_motion_measured=torch.tensor([motion.is_measured]),
        )
        if status is not TrackingStatus.LOST:
            self.last_found = stamp
        return T_new_old

    def replace_last(self, T_cw: Tensor) -> None:
        """Replace the pose of the last frame by a refined world-to-camera pose, float64, shape :math:`(4, 4)`."""
        self._frames["T_ck"][-1] = _relative(T_cw, self.keyframe)

    def poses_of(self, frames: Sequence[int]) -> Tensor:
        """World-to-camera poses of some frames in the current map.

        Args:
            frames: Positions of the frames in the history, from 0.

        Returns:
            Poses, float64, shape :math:`(N, 4, 4)`.
        """
        rows = torch.tensor(frames, dtype=torch.int64)
        return self._frames["T_ck"][rows] @ self._keyframe_poses()[self._frames["keyframe"][rows]]

    def trajectory(self) -> Trajectory:
        """Poses of all frames in the current map; poses of lost frames are interpolated between found frames."""
        frames = self._frames
        T_cw = frames["T_ck"] @ self._keyframe_poses()[frames["keyframe"]]
        found = frames["status"] != TRACKING_STATUSES.index(TrackingStatus.LOST)
        return Trajectory(frames["stamp"].clone(), invert(_interpolate(frames["stamp"], T_cw, found)))

    def _correct_lost(self, T_new_old: Tensor, keyframe: Keyframe | None, linked: bool, *, move_all: bool) -> None:
        """Move the lost frames at the end of the history: all, or those that measured motions link to the new frame."""
        frames = self._frames
        for row in reversed(range(len(frames))):
            if TRACKING_STATUSES[int(frames["status"][row])] is not TrackingStatus.LOST or not (linked or move_all):
                break
            frames["T_ck"][row] = _relative(self._pose_of(row) @ invert(T_new_old), keyframe)
            frames["keyframe"][row] = self._add_keyframe(keyframe)
            if linked:
                frames["status"][row] = TRACKING_STATUSES.index(TrackingStatus.ODOMETRY)
            linked = linked and bool(frames["is_motion_measured"][row])

    def _add_keyframe(self, keyframe: Keyframe | None) -> int:
        """Keep a keyframe to which a pose is relative, and return its index; -1 for None."""
        if keyframe is None:
            return -1
        self._keyframes[keyframe.index] = keyframe
        return keyframe.index

    def _keyframe_of(self, row: int) -> Keyframe | None:
        """Return the keyframe to which the pose of a frame is relative; None for the world frame."""
        return self._keyframes.get(int(self._frames["keyframe"][row]))

    def _current_status(self, code: int, keyframe: int) -> TrackingStatus:
        """Return the status of a row: a loop can have joined the part of the map of its keyframe with the rest."""
        status, reference = TRACKING_STATUSES[code], self._keyframes.get(keyframe)
        is_guess = status.is_localised and reference is not None and reference.is_disconnected
        return TrackingStatus.DISCONNECTED if is_guess else status

    def _pose_of(self, row: int) -> Tensor:
        """Return the world-to-camera pose of a frame in the current map, float64, shape (4, 4)."""
        return self._frames["T_ck"][row] @ _pose(self._keyframe_of(row))

    def _keyframe_poses(self) -> Tensor:
        """Return the poses of the keyframes by index, float64, shape (K + 1, 4, 4); the last one is the identity."""
        T_kw = torch.eye(4, dtype=torch.float64).repeat(max(self._keyframes, default=-1) + 2, 1, 1)
        T_kw[list(self._keyframes)] = stack_poses(list(self._keyframes.values()))
        return T_kw


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
