"""The pose of every frame, tied to a keyframe so that it follows when the map is corrected."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from v3d_torch.geometry.se3 import invert, rigid, se3_exp, se3_log
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.tracking.motion_model import PosePrediction
from v3d_torch.types import FramePose, TrackingStatus, Trajectory


@dataclass(frozen=True)
class _Entry:
    stamp: float
    status: TrackingStatus
    keyframe: Keyframe | None  # None before the first
    T_ck: Tensor
    linked: bool  # whether the motion since the frame before is known

    @property
    def T_cw(self) -> Tensor:
        return self.T_ck @ _pose(self.keyframe)


class PoseHistory:
    """Remembers the pose of each frame relative to a keyframe, and predicts the next one."""

    def __init__(self) -> None:
        self._entries: list[_Entry] = []
        self._velocity = torch.zeros(6, dtype=torch.float64)  # twist per second, in the camera frame
        self.passed: Tensor | None = None  # mean velocity around the frame before the last, where it is known
        self.landmarks = torch.zeros(0, dtype=torch.int64)  # seen by the last frame that was found

    @property
    def status(self) -> TrackingStatus | None:
        """Of the last frame; None before the first."""
        return self._entries[-1].status if self._entries else None

    @property
    def stamp(self) -> float:
        """Of the last frame, seconds; minus infinity before the first."""
        return self._entries[-1].stamp if self._entries else -torch.inf

    @property
    def located(self) -> bool:
        """Whether any frame was found so far."""
        return self._last_found() > -torch.inf

    @property
    def statuses(self) -> list[TrackingStatus]:
        """Of all frames."""
        return [entry.status for entry in self._entries]

    @property
    def T_cw(self) -> Tensor:
        """World to camera of the last frame, float64, shape :math:`(4, 4)`."""
        return self._entries[-1].T_cw if self._entries else torch.eye(4, dtype=torch.float64)

    @property
    def T_pw(self) -> Tensor:
        """World to camera of the frame before the last, of at least two, float64, shape :math:`(4, 4)`."""
        return self._entries[-2].T_cw

    def outlook(self) -> PosePrediction:
        """How the camera is expected to go on from the last frame; where there is none it stands at the origin."""
        stamp = self._entries[-1].stamp if self._entries else 0.0
        return PosePrediction(stamp, self.T_cw, self._velocity)

    def predict(self, stamp: float) -> Tensor:
        """``T_cw`` at ``stamp`` with constant velocity."""
        return self.outlook().at(stamp)

    def record(
        self, stamp: float, estimate: FramePose, keyframe: Keyframe | None, T_cp: Tensor | None = None
    ) -> Tensor | None:
        """Note a frame's pose relative to ``keyframe``.

        Lost frames whose motions up to a frame that is found are known are put where these say. So are, by a guess,
        those before the first that is found: their world was none.

        Args:
            stamp: seconds.
            estimate: of the frame.
            keyframe: that it is tied to.
            T_cp: the camera's motion since the frame before, previous camera to this one; None where it is not known.

        Returns:
            Where the camera is found for the first time: the correction of the world as it was guessed until then, new
            world from old, shape :math:`(4, 4)`; else None.
        """
        status = estimate.status
        if status is TrackingStatus.TRACKED and keyframe is not None and keyframe.disconnected:
            status = TrackingStatus.DISCONNECTED
        T_new_old = None
        if self.status is TrackingStatus.LOST and status is not TrackingStatus.LOST:
            expected = self.predict(stamp) if T_cp is None else T_cp @ self.T_cw
            correction, first = rigid(invert(estimate.T_cw) @ expected), not self.located
            self._put_right(correction, keyframe, linked=T_cp is not None, first=first)
            T_new_old = correction if first else None
        self.passed = None
        if self._entries:
            elapsed = stamp - self._entries[-1].stamp
            if estimate.status is TrackingStatus.LOST and T_cp is not None:
                self._velocity = se3_log(T_cp) / elapsed
            elif estimate.status is TrackingStatus.LOST:
                self._velocity = self._velocity * (stamp - self._last_found() < PosePrediction.LONGEST)
            elif self.status is not TrackingStatus.LOST and elapsed > 0:
                velocity = se3_log(estimate.T_cw @ invert(self.T_cw)) / elapsed
                if T_cp is not None:  # else it may be a jump to a place seen before
                    self.passed = (self._velocity + velocity) / 2 if self._entries[-1].linked else velocity
                self._velocity = velocity
        T_ck = _relative(estimate.T_cw, keyframe)
        self._entries.append(_Entry(stamp, status, keyframe, T_ck, linked=T_cp is not None))
        if estimate.count:
            self.landmarks = estimate.landmarks[estimate.landmarks >= 0]
        return T_new_old

    def correct(self, T_pw: Tensor) -> None:
        """Take the frame before the last for taken from another pose, which has become known since."""
        before = self._entries[-2]
        self._entries[-2] = replace(before, T_ck=_relative(T_pw, before.keyframe))

    def _put_right(self, T_new_old: Tensor, keyframe: Keyframe | None, *, linked: bool, first: bool) -> None:
        """Move the lost frames before one that is found, as far back as motions are known; all, before the first."""
        found = (
            TrackingStatus.DISCONNECTED if keyframe is not None and keyframe.disconnected else TrackingStatus.ODOMETRY
        )
        for index in reversed(range(len(self._entries))):
            entry = self._entries[index]
            if entry.status is not TrackingStatus.LOST or not (linked or first):
                break
            T_ck = _relative(entry.T_cw @ invert(T_new_old), keyframe)
            self._entries[index] = _Entry(
                entry.stamp, found if linked else TrackingStatus.LOST, keyframe, T_ck, entry.linked
            )
            linked = linked and entry.linked

    def anchor(self, keyframe: Keyframe) -> None:
        """The last frame became a keyframe: from now on its pose is the keyframe's, and so is what it saw."""
        status = self._entries[-1].status
        if keyframe.disconnected:
            status = TrackingStatus.DISCONNECTED
        elif status is TrackingStatus.LOST:
            status = TrackingStatus.TRACKED  # the first of all
        own = torch.eye(4, dtype=torch.float64)
        self._entries[-1] = _Entry(keyframe.stamp, status, keyframe, own, self._entries[-1].linked)
        self.landmarks = keyframe.landmarks[keyframe.landmarks >= 0]

    def trajectory(self) -> Trajectory:
        """All frames after all corrections; lost ones interpolated between their neighbours that were found."""
        stamps = torch.tensor([entry.stamp for entry in self._entries], dtype=torch.float64)
        T_cw = torch.cat([torch.zeros(0, 4, 4, dtype=torch.float64), *(entry.T_cw[None] for entry in self._entries)])
        found = torch.tensor([entry.status is not TrackingStatus.LOST for entry in self._entries])
        return Trajectory(stamps, invert(_interpolate(stamps, T_cw, found)))

    def _last_found(self) -> float:
        found = (entry.stamp for entry in reversed(self._entries) if entry.status is not TrackingStatus.LOST)
        return next(found, -torch.inf)


def _pose(keyframe: Keyframe | None) -> Tensor:
    """World to camera of a keyframe; the world itself, where there is none."""
    return torch.eye(4, dtype=torch.float64) if keyframe is None else keyframe.T_cw


def _relative(T_cw: Tensor, keyframe: Keyframe | None) -> Tensor:
    """A pose as it is tied to a keyframe, keyframe to camera, float64, shape :math:`(4, 4)`."""
    return rigid(T_cw @ invert(_pose(keyframe)))


def _interpolate(stamps: Tensor, T: Tensor, found: Tensor) -> Tensor:
    """Poses where ``found`` is false on the geodesic between the nearest that were found; the ends stay as they are."""
    known = torch.nonzero(found)[:, 0]
    if known.shape[0] == 0:
        return T
    after = torch.searchsorted(known, torch.arange(stamps.shape[0]))
    between = torch.nonzero(~found & (after > 0) & (after < known.shape[0]))[:, 0]
    a, b = known[after[between] - 1], known[after[between].clamp(max=known.shape[0] - 1)]
    share = (stamps[between] - stamps[a]) / (stamps[b] - stamps[a])
    T = T.clone()
    T[between] = se3_exp(share[:, None] * se3_log(T[b] @ invert(T[a]))) @ T[a]
    return T
