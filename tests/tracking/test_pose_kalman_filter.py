"""Kalman filter of pose and twist: consistency on simulated motions."""

from __future__ import annotations

import torch

from v3d_torch.geometry.se3 import invert, se3_exp, se3_log
from v3d_torch.tracking.pose_kalman_filter import PoseKalmanFilter, predict_covariance

NOISE = torch.tensor([0.004] * 3 + [0.003] * 3, dtype=torch.float64).square().diag()
ACCELERATION = torch.tensor([1.0] * 3 + [2.0] * 3, dtype=torch.float64)


def test_errors_of_simulated_motions_have_the_covariance_of_the_filter() -> None:
    """The mean NEES of pose and twist over 40 runs of half a second at 30 Hz is within its 95 % bounds.

    The errors of the pose that was measured last have the cross-covariance with those of the twist, too.
    """
    generator = torch.Generator().manual_seed(0)

    def normal() -> torch.Tensor:
        return torch.randn(6, dtype=torch.float64, generator=generator)

    dt, steps = 1 / 30, 10
    nees, correlations = [], []
    for _ in range(40):
        T_wc, twist = se3_exp(normal()), ACCELERATION * normal()
        estimate = PoseKalmanFilter()
        estimate.start(0.0, T_wc @ se3_exp(NOISE.sqrt() @ normal()), NOISE)
        for n in range(1, 16):
            for _ in range(steps):
                T_wc = T_wc @ se3_exp(twist * dt / steps)
                twist = twist + ACCELERATION * (dt / steps) ** 0.5 * normal()
            estimate.predict(n * dt)
            measured = T_wc @ se3_exp(NOISE.sqrt() @ normal())
            estimate.update(measured, NOISE)
        error = torch.cat([se3_log(invert(estimate.T_wc) @ T_wc), twist - estimate.twist])
        nees.append(error @ torch.linalg.solve(estimate.covariance, error))
        sigmas = (NOISE.diagonal() * estimate.covariance.diagonal()[6:]).sqrt()
        correlations.append((se3_log(invert(measured) @ T_wc) * error[6:] / sigmas).mean())
    mean = float(torch.stack(nees).mean())
    assert 12 - 2 * (24 / 40) ** 0.5 < mean < 12 + 2 * (24 / 40) ** 0.5
    expected = float((estimate.cross_covariance.diagonal() / sigmas).mean())
    assert abs(float(torch.stack(correlations).mean()) - expected) < 2 * (1 / 240) ** 0.5 < expected / 2


def test_covariance_stays_symmetric_and_positive_definite() -> None:
    estimate = PoseKalmanFilter()
    estimate.start(0.0, torch.eye(4, dtype=torch.float64), NOISE)
    for n in range(1, 200):
        estimate.predict(n / 30)
        estimate.update(torch.eye(4, dtype=torch.float64), NOISE)
    torch.testing.assert_close(estimate.covariance, estimate.covariance.T)
    assert torch.linalg.eigvalsh(estimate.covariance).min() > 0
    joint = torch.cat(
        [
            torch.cat([NOISE, estimate.cross_covariance], dim=1),
            torch.cat([estimate.cross_covariance.T, estimate.covariance[6:, 6:]], dim=1),
        ]
    )
    assert torch.linalg.eigvalsh(joint).min() > 0  # with the pose as it was measured


def test_error_of_the_pose_turns_with_the_predicted_camera() -> None:
    """The motion after the error is the derivative of the predicted pose."""
    twist, elapsed = torch.tensor([1.0, -2.0, 0.5, 2.0, -1.0, 1.5], dtype=torch.float64), 0.2
    motion, zeros = se3_exp(twist * elapsed), torch.zeros(12, 12, dtype=torch.float64)
    covariance = torch.block_diag(torch.arange(1.0, 7.0).double().diag(), zeros[6:, 6:])
    jacobian = torch.autograd.functional.jacobian(
        lambda error: se3_log(invert(motion) @ se3_exp(error) @ motion), torch.zeros(6, dtype=torch.float64)
    )
    grown = predict_covariance(covariance, twist, elapsed) - predict_covariance(zeros, twist, elapsed)
    torch.testing.assert_close(grown[:6, :6], jacobian @ covariance[:6, :6] @ jacobian.T)


def test_former_twist_becomes_uncertainty_when_the_camera_stops() -> None:
    estimate = PoseKalmanFilter()
    twist = torch.arange(6, dtype=torch.float64)
    estimate.start(0.0, torch.eye(4, dtype=torch.float64), NOISE, twist)
    before = estimate.covariance
    estimate.stop()
    assert not estimate.twist.any()
    torch.testing.assert_close((estimate.covariance - before)[6:, 6:], twist.outer(twist))
