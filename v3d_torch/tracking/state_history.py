"""History of camera states of the last seconds: interpolation between frames, prediction after the last one."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from torch import Tensor

from v3d_torch.errors import InputError
from v3d_torch.geometry.se3 import adjoint, invert, orthonormalise, se3_exp, se3_log
from v3d_torch.odometry.odometry import CameraMotion
from v3d_torch.tracking.camera_state import CameraState
from v3d_torch.tracking.pose_kalman_filter import interpolation_covariances

_DURATION = 10.0
"""Time for which states are stored, seconds, the same as in the transform buffer of ROS."""

_MAX_PREDICTION = 86_400.0
"""Maximum time after the last frame, seconds, a day: a later time is one of another clock, or in another unit."""


class _History(NamedTuple):
    """States of the last frames, and time and measured motion of the next frame while its state is not known yet."""

    states: tuple[CameraState, ...] = ()
    next_motion: tuple[float, CameraMotion] | None = None


class StateHistory:
    """States of the camera at the last frames. Other threads can read them while one thread appends states."""

    def __init__(self) -> None:
        self._history = _History()  # replaced and never changed, so that threads can read it

    def append(self, state: CameraState) -> None:
        """Append the state at a frame, and remove states that are older than 10 s.

        The newest of these is kept, because the pose 10 s ago is interpolated between it and the next one.
        """
        states = self._history.states
        first = max(bisect_right(states, state.stamp - _DURATION, key=_stamp) - 1, 0)
        self._history = _History((*states[first:], state))

    def append_motion(self, stamp: float, motion: CameraMotion) -> None:
        """Store the measured motion to a frame that is still being tracked.

        Until `append` gives the state of that frame, `at` uses the last state, moved by this motion. The covariance at
        the new frame is that of a prediction, and so larger than the actual one. A motion that was not measured is
        ignored, because it is a prediction itself.

        Args:
            stamp: Time of the new frame, seconds.
            motion: Motion of the camera from the last state to this frame.
        """
        states = self._history.states
        if states and motion.is_measured:
            self._history = _History(states, (stamp, motion))

    def at(self, stamp: float) -> CameraState:
        """Return the state at a time.

        Between two frames the pose is interpolated along the geodesic. The covariance includes the unknown motion
        between them, which is large in a gap of the frames. It is large enough whatever the correlation between the
        errors of both frames. After the last frame see `CameraState.predict`.

        Args:
            stamp: Time, seconds.

        Raises:
            InputError: If the time is not finite, before the first stored state or more than a day after the last one,
                or if no frame has been tracked.
        """
        states = self._known_states()
        if not math.isfinite(stamp):
            raise InputError(f"no state at {stamp} s: the time is not finite")
        if not states:
            raise InputError(f"no state at {stamp:.6f} s: no frame has been tracked; track a frame first")
        if stamp < states[0].stamp:
            raise InputError(
                f"no state at {stamp:.6f} s: only states of the last {_DURATION:g} s are stored, since"
                f" {states[0].stamp:.6f} s; give a later time"
            )
        if stamp > states[-1].stamp + _MAX_PREDICTION:
            raise InputError(
                f"no state at {stamp:.6g} s: the last frame is of {states[-1].stamp:.6f} s; give a time in seconds, in"
                " the clock of the frames"
            )
        index = bisect_right(states, stamp, key=_stamp) - 1
        if index == len(states) - 1:
            return states[-1].predict(stamp)
        return _interpolate(states[index], states[index + 1], stamp)

    def apply_world_correction(self, T_new_old: Tensor) -> None:
        """Transform the states into the corrected world frame.

        Args:
            T_new_old: Transform from the old to the corrected world frame, float64, shape :math:`(4, 4)`.
        """
        states, next_motion = self._history
        moved = (replace(state, T_wc=orthonormalise(T_new_old @ state.T_wc)) for state in states)
        self._history = _History(tuple(moved), next_motion)

    def state_dict(self) -> dict[str, Any]:
        """Return the states."""
        return {"states": list(self._history.states)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the states of `state_dict`."""
        self._history = _History(tuple(state["states"]))

    def _known_states(self) -> tuple[CameraState, ...]:
        """Return the states of the last frames, with that of the next frame if its motion is known."""
        states, next_motion = self._history  # read once, because another thread can replace it
        if next_motion is None:
            return states
        (stamp, motion), last = next_motion, states[-1]
        T_wc = orthonormalise(last.T_wc @ invert(motion.T_cp))
        return (*states, replace(last.predict(stamp), status=last.status, T_wc=T_wc, twist=-motion.velocity))


def _interpolate(a: CameraState, b: CameraState, stamp: float) -> CameraState:
    """Interpolate two states at a time between them."""
    fraction = (stamp - a.stamp) / (b.stamp - a.stamp)
    xi = se3_log(invert(a.T_wc) @ b.T_wc)
    Ad_a, Ad_b = adjoint(se3_exp(-fraction * xi)), adjoint(se3_exp((1 - fraction) * xi))

    def blend(of_a: Tensor, of_b: Tensor) -> Tensor:
        return (1 - fraction) * Ad_a @ of_a @ Ad_a.T + fraction * Ad_b @ of_b @ Ad_b.T

    of_pose, of_twist = interpolation_covariances(stamp - a.stamp, b.stamp - stamp)
    return CameraState(
        stamp=stamp,
        T_wc=orthonormalise(a.T_wc @ se3_exp(fraction * xi)),
        status=a.status if fraction < 0.5 else b.status,
        twist=(1 - fraction) * a.twist + fraction * b.twist,
        covariance=blend(a.covariance, b.covariance) + of_pose,
        twist_covariance=blend(a.twist_covariance, b.twist_covariance) + of_twist,
        cross_covariance=blend(a.cross_covariance, b.cross_covariance),
    )


def _stamp(state: CameraState) -> float:
    return state.stamp
