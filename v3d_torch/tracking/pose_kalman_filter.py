"""Kalman filter of pose and twist of a camera, with constant velocity on SE(3) and white acceleration noise.

Errors are right perturbations in the camera frame, in the order pose, twist (Sola, Deray and Atchuthan, A micro Lie
theory for state estimation in robotics, 2018, Sec. V).
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from v3d_torch.geometry.se3 import adjoint, invert, orthonormalise, se3_exp, se3_log
from v3d_torch.runtime.stateful import StatefulComponent

_SPEED_SIGMA, _RATE_SIGMA = 1.0, 2.0
"""Standard deviation of an unknown velocity, m/s and rad/s, and of the change of the velocity in one second: a handheld
camera can stop or reverse within a second. A robot is slower; its covariances are therefore too large."""

_TWIST_COVARIANCE = torch.tensor([_SPEED_SIGMA] * 3 + [_RATE_SIGMA] * 3, dtype=torch.float64).square().diag()


class PoseKalmanFilter(StatefulComponent):
    """Kalman filter of pose and twist of the camera. Call `start` before any other method.

    Attributes:
        stamp: Time of the state, seconds; NaN before the first `start`.
        T_wc: Filtered camera-to-world pose, float64, shape :math:`(4, 4)`.
        twist: Filtered twist in the camera frame, m/s and rad/s, float64, shape :math:`(6,)`.
        covariance: Covariance of the errors of pose and twist, float64, shape :math:`(12, 12)`.
    """

    _STATE = ("stamp", "T_wc", "twist", "covariance")

    def __init__(self) -> None:
        self.start(math.nan, torch.eye(4, dtype=torch.float64), torch.zeros(6, 6, dtype=torch.float64))

    @property
    def is_started(self) -> bool:
        """True once `start` was called."""
        return not math.isnan(self.stamp)

    @property
    def cross_covariance(self) -> Tensor:
        """Cross-covariance of the errors of pose (rows) and twist (columns), float64, shape :math:`(6, 6)`.

        It is the same for the filtered pose and for the last measured one: with the covariances P of the prediction, R
        of the measurement and S of the innovation, both are ``R @ S^-1 @ P[:6, 6:]``.
        """
        return self.covariance[:6, 6:]

    def start(self, stamp: float, T_wc: Tensor, covariance: Tensor, twist: Tensor | None = None) -> None:
        """Reset the state to a measured pose.

        Args:
            stamp: Time, seconds.
            T_wc: Camera-to-world pose, float64, shape :math:`(4, 4)`.
            covariance: Covariance of its right perturbation, float64, shape :math:`(6, 6)`.
            twist: Expected twist, m/s and rad/s, float64, shape :math:`(6,)`; None for zero.
        """
        self.stamp = stamp
        self.T_wc = T_wc
        self.twist = torch.zeros(6, dtype=torch.float64) if twist is None else twist
        self.covariance = torch.block_diag(covariance, _TWIST_COVARIANCE)

    def predict(self, stamp: float) -> None:
        """Predict the state at a later time, seconds."""
        elapsed = stamp - self.stamp
        self.covariance = predict_covariance(self.covariance, self.twist, elapsed)
        self.stamp, self.T_wc = stamp, orthonormalise(self.T_wc @ se3_exp(self.twist * elapsed))

    def update(self, T_wc: Tensor, covariance: Tensor) -> None:
        """Correct the state with a measured pose at its time.

        Args:
            T_wc: Camera-to-world pose, float64, shape :math:`(4, 4)`.
            covariance: Covariance of its right perturbation, float64, shape :math:`(6, 6)`.
        """
        P, R = self.covariance.numpy(), covariance.numpy()  # NumPy is faster than torch for single matrices
        gain = np.linalg.solve(P[:6, :6] + R, P[:6]).T
        correction = torch.from_numpy(gain) @ se3_log(invert(self.T_wc) @ T_wc)
        self.T_wc = orthonormalise(self.T_wc @ se3_exp(correction[:6]))
        self.twist = self.twist + correction[6:]
        kept = np.eye(12)  # Joseph form, which stays symmetric and positive definite
        kept[:, :6] -= gain
        self.covariance = torch.from_numpy(kept @ P @ kept.T + gain @ R @ gain.T)

    def stop(self) -> None:
        """Set the twist to zero, and add its former value to the uncertainty."""
        self.covariance = stop_covariance(self.covariance, self.twist)
        self.twist = torch.zeros_like(self.twist)


def join_covariances(covariance: Tensor, cross_covariance: Tensor, twist_covariance: Tensor) -> Tensor:
    """Covariance of the errors of pose and twist, shape :math:`(12, 12)`, from its blocks of shape :math:`(6, 6)`."""
    return torch.cat(
        [torch.cat([covariance, cross_covariance], dim=1), torch.cat([cross_covariance.T, twist_covariance], dim=1)]
    )


def predict_covariance(covariance: Tensor, twist: Tensor, elapsed: float) -> Tensor:
    """Covariance of the errors of pose and twist after some time with unknown acceleration.

    Args:
        covariance: Covariance before, float64, shape :math:`(12, 12)`.
        twist: Twist in the camera frame, m/s and rad/s, float64, shape :math:`(6,)`.
        elapsed: Time, seconds.
    """
    # NumPy is faster than torch for a single matrix.
    F = np.eye(12)
    F[:6, :6] = adjoint(se3_exp(-elapsed * twist)).numpy()
    F[:6, 6:] = elapsed * np.eye(6)
    density = np.array([[elapsed**3 / 3, elapsed**2 / 2], [elapsed**2 / 2, elapsed]])
    return torch.from_numpy(F @ covariance.numpy() @ F.T + np.kron(density, _TWIST_COVARIANCE.numpy()))


def stop_covariance(covariance: Tensor, twist: Tensor) -> Tensor:
    """Covariance of the errors of pose and twist, (12, 12), after the expected twist, (6,), is set to zero."""
    return covariance + torch.block_diag(torch.zeros(6, 6), twist.outer(twist))


def interpolation_covariances(before: float, after: float) -> tuple[Tensor, Tensor]:
    r"""Covariances of the errors of pose and twist that are interpolated between two known states.

    Unknown acceleration moves the camera off the interpolated path. White noise of density q displaces it by the
    variance :math:`q s^2 (T - s)^2 / 3 T` at the time s of an interval T, and its velocity by :math:`q s (T - s) / T`
    (a Brownian bridge); both errors are independent.

    Args:
        before: Time since the state before, seconds.
        after: Time until the state after, seconds.

    Returns:
        Covariance of the pose and of the twist, float64, shape :math:`(6, 6)` each.
    """
    bridge = before * after / (before + after)
    return before * after * bridge / 3 * _TWIST_COVARIANCE, bridge * _TWIST_COVARIANCE
