"""Perspective-three-point problem against known poses."""

from __future__ import annotations

import torch

from v3d_torch.features.p3p import solve_p3p
from v3d_torch.geometry.se3 import invert, se3_exp


def test_one_solution_is_the_true_pose() -> None:
    """For random points in front of the camera, near and far, up to the conditioning of the problem."""
    generator = torch.Generator().manual_seed(0)
    T_cw = se3_exp(torch.randn(500, 6, generator=generator, dtype=torch.float64))
    in_camera = torch.randn(500, 3, 3, generator=generator, dtype=torch.float64)
    in_camera[..., 2] = 1 + 3 * torch.rand(500, 3, generator=generator, dtype=torch.float64)
    T_wc = invert(T_cw)
    points = in_camera @ T_wc[:, :3, :3].mT + T_wc[:, None, :3, 3]
    found = solve_p3p(points, 2.5 * in_camera / in_camera[..., 2:])  # the directions may have any length
    assert found.shape == (500, 4, 4, 4)
    error = (found - T_cw[:, None]).abs().amax(dim=(-2, -1)).nan_to_num(nan=torch.inf).amin(dim=-1)
    assert error.median() < 1e-12 and (error < 1e-6).double().mean() > 0.99


def test_degenerate_points_are_not_a_number_or_a_rigid_motion() -> None:
    line = torch.tensor([[0.0, 0, 2], [0, 0, 3], [0, 0, 4]], dtype=torch.float64)
    for points in (line, torch.ones(3, 3, dtype=torch.float64)):
        found = solve_p3p(points, points)
        finite = found[found.isfinite().all(dim=(-2, -1))]
        R = finite[:, :3, :3]
        torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=torch.float64).expand_as(R))
