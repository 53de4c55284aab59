"""Size of a measured trajectory relative to an estimated one."""

from __future__ import annotations

import pytest
import torch

from v3d_torch.calibration.metric_scale import metric_scale
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.types import Trajectory


def make_trajectory(
    count: int = 60, scale: float = 1.0, noise: float = 0.0, seed: int = 0, size: float = 1.0
) -> Trajectory:
    """A hand-held camera that moves by some decimetres, with noisy positions."""
    time = torch.arange(count, dtype=torch.float64) / 10
    waves = torch.stack([torch.sin(k * time + k) for k in (1.0, 0.7, 1.3)], dim=1)
    T_wc = se3_exp(torch.cat([0.3 * size * waves, 0.2 * waves], dim=1))
    error = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    T_wc[:, :3, 3] = scale * T_wc[:, :3, 3] + noise * error
    return Trajectory(time, T_wc)


def test_scale_is_found() -> None:
    moved = make_trajectory(scale=1.25)
    world = se3_exp(torch.tensor([1.0, -2.0, 0.5, 0.3, 0.9, -0.4], dtype=torch.float64))
    found = metric_scale(Trajectory(moved.stamps, world @ moved.T_wc), make_trajectory())
    assert found is not None
    assert found.ratio == pytest.approx(1.25, rel=1e-6) and found.sigma < 1e-6 and found.blocks == 10


@pytest.mark.parametrize("scale", [0.2, 1.0, 5.0])
def test_errors_agree_with_the_uncertainty(scale: float) -> None:
    squared = []
    for seed in range(20):
        found = metric_scale(make_trajectory(scale=scale), make_trajectory(noise=0.005, seed=seed))
        assert found is not None
        squared.append(((found[0] - scale) / found[1]) ** 2)
    assert 0.3 < sum(squared) / len(squared) < 2.0


def test_errors_of_the_estimate_do_not_shrink_the_scale() -> None:
    """The positions are spread by 0.3 m; a regression on the estimated ones would give 0.97."""
    found = [metric_scale(make_trajectory(200), make_trajectory(200, noise=0.04, seed=seed)) for seed in range(20)]
    mean = sum(each[0] for each in found if each is not None) / len(found)
    assert mean == pytest.approx(1.0, abs=0.005)


def test_few_poses_and_a_camera_that_only_turns_give_no_scale() -> None:
    assert metric_scale(make_trajectory(5), make_trajectory(5)) is None
    assert metric_scale(make_trajectory(size=0.0), make_trajectory(size=0.0)) is None
    assert metric_scale(make_trajectory(), make_trajectory(scale=0.0)) is None


def test_positions_that_are_not_correlated_give_no_scale() -> None:
    """All combinations of four signs: two are the measured position, the others the estimated one."""
    signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=torch.float64)] * 4)
    stamps, T_wc = torch.arange(16, dtype=torch.float64), torch.eye(4, dtype=torch.float64).repeat(2, 16, 1, 1)
    T_wc[0, :, :2, 3], T_wc[1, :, :2, 3] = signs[:, :2], signs[:, 2:]
    assert metric_scale(Trajectory(stamps, T_wc[0]), Trajectory(stamps, T_wc[1])) is None
