"""Random scenes for bundle adjustment: true poses and points, their observations, and an inaccurate estimate."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from helpers.random_numbers import RandomNumbers
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.mapping.bundle_adjustment import BundleAdjustment, bundle_adjust
from v3d_torch.optim.reprojection import Measurements, reprojection_residuals

CAMERA = PinholeCamera(fx=535.4, fy=539.2, cx=320.1, cy=247.6)
DEPTH_SIGMA = 0.0025


class Scene:
    """True poses and points, their noisy observations, and an inaccurate initial estimate.

    Args:
        poses: Number of poses.
        points: Number of points.
        observers: Number of poses that observe each point.
        noise: Factor of the measurement noise.
        seed: Seed of all random numbers.
    """

    def __init__(self, poses: int, points: int, observers: int, noise: float = 1.0, seed: int = 0) -> None:
        random = RandomNumbers(seed)
        spread = torch.tensor([0.3, 0.2, 0.1, 0.05, 0.08, 0.05], dtype=torch.float64)
        self.T_cw = se3_exp(random.normal(poses, 6) * spread)
        uv = random.uniform(points, 2) * torch.tensor([640.0, 480.0], dtype=torch.float64)
        self.points = CAMERA.back_project(uv, 1 + 3 * random.uniform(points))
        orders = [torch.randperm(poses, generator=random.generator) for _ in range(points)]
        pose = torch.stack([order[:observers] for order in orders]).flatten()
        point = torch.arange(points).repeat_interleave(observers)
        count = pose.shape[0]
        T = self.T_cw[pose]
        in_camera = (T[:, :3, :3] @ self.points[point, :, None])[..., 0] + T[:, :3, 3]
        sigma = 1.2 ** torch.randint(0, 8, (count,), generator=random.generator).to(torch.float64)
        inverse_depth = 1 / in_camera[:, 2] + noise * DEPTH_SIGMA * random.normal(count)
        inverse_depth[random.uniform(count) < 0.3] = 0.0
        self.measured = Measurements(
            uv=CAMERA.project(in_camera) + noise * sigma[:, None] * random.normal(count, 2),
            inverse_depth=inverse_depth,
            pixel_sigma=sigma,
            inverse_depth_sigma=DEPTH_SIGMA,
        )
        self.pose, self.point = pose, point
        self.fixed = torch.arange(poses) == 0
        error = 0.02 * random.normal(poses, 6)
        self.start = torch.where(self.fixed[:, None, None], self.T_cw, se3_exp(error) @ self.T_cw)
        self.start_points = self.points + 0.02 * random.normal(points, 3)

    @property
    def observations(self) -> dict[str, Any]:
        """Arguments of `bundle_adjust` beside the initial poses and points."""
        return {**vars(self.measured), "pose": self.pose, "point": self.point, "K": CAMERA.K, "fixed": self.fixed}

    def adjust(self, **arguments: Any) -> BundleAdjustment:
        """Adjust the initial estimate; arguments replace those of the scene."""
        return bundle_adjust(**({"T_cw": self.start, "points": self.start_points} | self.observations | arguments))

    def residuals(self, T_cw: Tensor, points: Tensor) -> Tensor:
        T = T_cw[self.pose]
        in_camera = (T[:, :3, :3] @ points[self.point, :, None])[..., 0] + T[:, :3, 3]
        return reprojection_residuals(in_camera, self.measured, CAMERA.K)
