"""Random trajectories, and the same motion with errors."""

from __future__ import annotations

import pytest
import torch

from v3d_torch.evaluation.statistics import Statistics
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.types import Trajectory


def random_walk(poses: int, seed: int, rate: float = 30.0, step: float = 0.05) -> Trajectory:
    """Random walk, evenly spaced in time."""
    generator = torch.Generator().manual_seed(seed)
    steps = se3_exp(step * torch.randn(poses, 6, dtype=torch.float64, generator=generator))
    T_wc = [se3_exp(torch.randn(6, dtype=torch.float64, generator=generator))]
    for motion in steps[1:]:
        T_wc.append(T_wc[-1] @ motion)
    return Trajectory(1000 + torch.arange(poses, dtype=torch.float64) / rate, torch.stack(T_wc))


def noisy(trajectory: Trajectory, seed: int, sigma: float = 0.02) -> Trajectory:
    """The same motion with errors, in another world frame."""
    generator = torch.Generator().manual_seed(seed)
    noise = se3_exp(sigma * torch.randn(len(trajectory), 6, dtype=torch.float64, generator=generator))
    T_ew = se3_exp(torch.randn(6, dtype=torch.float64, generator=generator))
    return Trajectory(trajectory.stamps, T_ew @ trajectory.T_wc @ noise)


def arc(scale: tuple[float, float, float] = (1.0, 0.1, 0.5)) -> Trajectory:
    """Smooth curve with a different extent along each axis, 60 poses in 4 s, all with the same orientation."""
    s = torch.linspace(0, 4, 60, dtype=torch.float64)
    T_wc = torch.eye(4, dtype=torch.float64).repeat(60, 1, 1)
    T_wc[:, :3, 3] = torch.stack([s.cos(), s, (2 * s).sin()], dim=1) * torch.tensor(scale, dtype=torch.float64)
    return Trajectory(s, T_wc)


def shaken(trajectory: Trajectory, sigma: float = 0.05) -> Trajectory:
    """The same trajectory with noise on the positions, in the same world frame."""
    T_wc = trajectory.T_wc.clone()
    noise = torch.randn(len(trajectory), 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    T_wc[:, :3, 3] += sigma * noise
    return Trajectory(trajectory.stamps, T_wc)


def assert_statistics(ours: Statistics, expected: dict[str, float]) -> None:
    """Compare all statistics of errors."""
    for name in ("rmse", "mean", "median", "std", "min", "max"):
        assert getattr(ours, name) == pytest.approx(expected[name], abs=1e-9), name
