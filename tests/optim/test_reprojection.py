"""Whitened reprojection residuals: convention and Jacobian."""

from __future__ import annotations

import torch
from helpers.measured_landmarks import CAMERA, measure_landmarks
from torch import Tensor

from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.optim.reprojection import Measurements, reprojection_jacobian, reprojection_residuals


def test_convention_residuals_are_projection_minus_measurement() -> None:
    measured = Measurements(
        uv=torch.tensor([[320.1, 247.6], [320.1, 247.6]], dtype=torch.float64),
        inverse_depth=torch.tensor([0.5, 0.0], dtype=torch.float64),
        pixel_sigma=torch.tensor([2.0, 2.0], dtype=torch.float64),
        inverse_depth_sigma=0.1,
    )
    points = torch.tensor([[0.01, 0.02, 1.0]] * 2, dtype=torch.float64)
    residuals = reprojection_residuals(points, measured, CAMERA.K)
    expected = [[535.4 * 0.01 / 2, 539.2 * 0.02 / 2, 0.5 / 0.1], [535.4 * 0.01 / 2, 539.2 * 0.02 / 2, 0.0]]
    torch.testing.assert_close(residuals, torch.tensor(expected, dtype=torch.float64))


def test_jacobian_equals_autograd() -> None:
    T_cw, points, measured, _ = measure_landmarks(20)

    def residuals(xi: Tensor) -> Tensor:
        T = se3_exp(xi) @ T_cw
        return reprojection_residuals(points @ T[:3, :3].T + T[:3, 3], measured, CAMERA.K)

    expected = torch.autograd.functional.jacobian(residuals, torch.zeros(6, dtype=torch.float64))
    jacobian = reprojection_jacobian(points @ T_cw[:3, :3].T + T_cw[:3, 3], measured, CAMERA.K)
    torch.testing.assert_close(jacobian, expected, rtol=1e-10, atol=1e-8)
