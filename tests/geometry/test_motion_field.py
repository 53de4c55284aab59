"""The motion field: how the image of a camera in motion moves."""

from __future__ import annotations

import torch

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.motion_field import motion_field
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.optim.reprojection import perspective_jacobian

CAMERA = PinholeCamera(525.0, 520.0, 320.0, 240.0)
SHAKE = torch.tensor([0.5, -0.4, 0.6, 0.9, -1.1, 1.3], dtype=torch.float64)  # m/s and rad/s


def points() -> torch.Tensor:
    """In the camera frame, metres, (N, 3)."""
    generator = torch.Generator().manual_seed(1)
    return torch.rand(100, 3, generator=generator, dtype=torch.float64) * torch.tensor([2, 2, 3]) + torch.tensor(
        [-1, -1, 1]
    )


def test_it_is_the_derivative_of_where_points_are_seen() -> None:
    seen, seconds = points(), 1e-6
    earlier, later = (seen @ T[:3, :3].T + T[:3, 3] for T in (se3_exp(-seconds * SHAKE), se3_exp(seconds * SHAKE)))
    moves, rate = motion_field(CAMERA.project(seen), 1 / seen[:, 2], SHAKE, CAMERA)
    torch.testing.assert_close(
        moves, (CAMERA.project(later) - CAMERA.project(earlier)) / (2 * seconds), rtol=1e-6, atol=1e-6
    )
    torch.testing.assert_close(rate, (1 / later[:, 2] - 1 / earlier[:, 2]) / (2 * seconds), rtol=1e-6, atol=1e-6)


def test_it_is_what_pose_refinement_linearises() -> None:
    seen = points()
    uv, inverse_depth = CAMERA.project(seen), 1 / seen[:, 2]
    linear = torch.tensordot(SHAKE, perspective_jacobian(torch.cat([CAMERA.slopes(uv).T, inverse_depth[None]])), dims=1)
    moves, rate = motion_field(uv, inverse_depth, SHAKE, CAMERA)
    torch.testing.assert_close(moves, linear[:2].T * CAMERA.focal)
    torch.testing.assert_close(rate, linear[2])


def test_what_is_far_away_moves_by_the_rotation_alone() -> None:
    uv, nothing = CAMERA.project(points()), torch.zeros(100, dtype=torch.float64)
    turn = torch.cat([torch.zeros(3, dtype=torch.float64), SHAKE[3:]])
    for far, turned in zip(
        motion_field(uv, nothing, SHAKE, CAMERA), motion_field(uv, nothing, turn, CAMERA), strict=True
    ):
        torch.testing.assert_close(far, turned)
