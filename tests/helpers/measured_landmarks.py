"""A camera that measures random landmarks with known noise and outliers."""

from __future__ import annotations

import torch
from torch import Tensor

from helpers.random_numbers import RandomNumbers
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.optim.reprojection import Measurements

CAMERA = PinholeCamera(fx=535.4, fy=539.2, cx=320.1, cy=247.6)
INVERSE_DEPTH_SIGMA = 0.0025


def measure_landmarks(count: int, outliers: float = 0.0, seed: int = 1) -> tuple[Tensor, Tensor, Measurements, Tensor]:
    """A pose ``T_cw``, landmarks, their measurements with the claimed noise, and a mask of the correct measurements."""
    random = RandomNumbers(seed)
    T_cw = se3_exp(0.5 * random.normal(6))
    uv = random.uniform(count, 2) * torch.tensor([640.0, 480.0], dtype=torch.float64)
    depth = 0.5 + 3.5 * random.uniform(count)
    T_wc = invert(T_cw)
    points = CAMERA.back_project(uv, depth) @ T_wc[:3, :3].T + T_wc[:3, 3]
    sigma = 1.2 ** torch.randint(0, 8, (count,), generator=random.generator).to(torch.float64)
    uv = uv + sigma[:, None] * random.normal(count, 2)
    inverse_depth = 1 / depth + INVERSE_DEPTH_SIGMA * random.normal(count)
    inverse_depth[::3] = 0.0
    correct = random.uniform(count) >= outliers
    uv[~correct] = random.uniform(count, 2)[~correct] * 400
    measured = Measurements(
        uv=uv, inverse_depth=inverse_depth, pixel_sigma=sigma, inverse_depth_sigma=INVERSE_DEPTH_SIGMA
    )
    return T_cw, points, measured, correct
