"""Steps of inverse depth of simulated cameras."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from v3d_torch.calibration.depth_steps import disparity_step


def room_depth() -> Tensor:
    """Depth of surfaces between 0.7 and 4.5 m, metres."""
    return 0.7 + 3.8 * torch.rand(40_000, generator=torch.Generator().manual_seed(1))


def in_steps(depth: Tensor, step: float, unit: float = 1e-3) -> Tensor:
    """Depth of a camera that measures inverse depth in steps, rounded to a unit of length."""
    return (1 / (step * (1 / (depth * step)).round()) / unit).round() * unit


@pytest.mark.parametrize("step", [0.0029, 0.0032, 0.0145, 0.0008])
def test_step_is_found(step: float) -> None:
    assert disparity_step(in_steps(room_depth(), step)) == pytest.approx(step, rel=0.03)


@pytest.mark.parametrize("factor", [0.2, 0.8, 1.25, 5.0])
def test_step_follows_the_scale_of_the_depth(factor: float) -> None:
    assert disparity_step(factor * in_steps(room_depth(), 0.0029)) == pytest.approx(0.0029 / factor, rel=0.03)


def test_noise_of_other_pixels_does_not_hide_the_step() -> None:
    depth = in_steps(room_depth(), 0.0029)
    depth[::2] = room_depth()[::2]
    assert disparity_step(depth) == pytest.approx(0.0029, rel=0.03)


def test_step_is_the_largest_if_fractions_of_it_fit_better() -> None:
    """A fifth of the measurements lies between two steps, so that all are multiples of half a step."""
    step, random = 0.0029, torch.rand(40_000, generator=torch.Generator().manual_seed(3))
    steps = (1 / (room_depth() * step)).round() + 0.5 * (random < 0.2)
    assert disparity_step(1 / (step * steps)) == pytest.approx(step, rel=0.03)


def test_few_parallel_walls_have_no_step() -> None:
    for walls in (1, 2, 5, 12):
        depth = 1 + 3 * torch.rand(walls, generator=torch.Generator().manual_seed(walls))
        noise = 1 + 2e-4 * torch.randn(4000, 1, generator=torch.Generator().manual_seed(2))
        assert disparity_step((depth * noise).flatten()) is None


@pytest.mark.parametrize("unit", [1e-3, 1e-2])
def test_depth_in_steps_of_length_has_no_step_of_inverse_depth(unit: float) -> None:
    assert disparity_step((room_depth() / unit).round() * unit) is None


def test_empty_depth_has_no_step() -> None:
    assert disparity_step(torch.zeros(4, 5)) is None
    assert disparity_step(torch.full((3,), 0.01)) is None
