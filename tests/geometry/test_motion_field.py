"""Motion field against finite differences and against the Jacobian of the projection."""

from __future__ import annotations

import torch

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.motion_field import motion_field
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.optim.reprojection import perspective_jacobian

CAMERA = PinholeCamera(525.0, 520.0, 320.0, 240.0)
VELOCITY = torch.tensor([0.5, -0.4, 0.6, 0.9, -1.1, 1.3], dtype=torch.float64)  # m/s and rad/s


def random_points() -> torch.Tensor:
    """Points in front of the camera, metres, (N, 3)."""
    generator = torch.Generator().manual_seed(1)
    return torch.rand(100, 3, generator=generator, dtype=torch.float64) * torch.tensor([2, 2, 3]) + torch.tensor(
        [-1, -1, 1]
    )


def test_motion_field_is_the_time_derivative_of_the_projection() -> None:
    points, dt = random_points(), 1e-6
    earlier, later = (points @ T[:3, :3].T + T[:3, 3] for T in (se3_exp(-dt * VELOCITY), se3_exp(dt * VELOCITY)))
    pixel_velocity, rate = motion_field(CAMERA.project(points), 1 / points[:, 2], VELOCITY, CAMERA.K)
    torch.testing.assert_close(
        pixel_velocity, (CAMERA.project(later) - CAMERA.project(earlier)) / (2 * dt), rtol=1e-6, atol=1e-6
    )
    torch.testing.assert_close(rate, (1 / later[:, 2] - 1 / earlier[:, 2]) / (2 * dt), rtol=1e-6, atol=1e-6)


def test_motion_field_equals_the_perspective_jacobian_times_the_velocity() -> None:
    points = random_points()
    uv, inverse_depth = CAMERA.project(points), 1 / points[:, 2]
    projected = torch.cat([CAMERA.normalise(uv).T, inverse_depth[None]])
    linear = torch.tensordot(VELOCITY, perspective_jacobian(projected), dims=1)
    pixel_velocity, rate = motion_field(uv, inverse_depth, VELOCITY, CAMERA.K)
    torch.testing.assert_close(pixel_velocity, linear[:2].T * CAMERA.focal_lengths)
    torch.testing.assert_close(rate, linear[2])


def test_infinitely_far_points_move_by_the_rotation_alone() -> None:
    uv, inverse_depth = CAMERA.project(random_points()), torch.zeros(100, dtype=torch.float64)
    rotation = torch.cat([torch.zeros(3, dtype=torch.float64), VELOCITY[3:]])
    for moved, rotated in zip(
        motion_field(uv, inverse_depth, VELOCITY, CAMERA.K),
        motion_field(uv, inverse_depth, rotation, CAMERA.K),
        strict=True,
    ):
        torch.testing.assert_close(moved, rotated)
