"""Random samples of RANSAC in torch, and the choice of the best hypothesis."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.features.sampling import draw_samples, find_best_hypothesis, gather_samples


@given(st.lists(st.booleans(), min_size=5, max_size=30), st.integers(0, 99))
def test_samples_contain_different_valid_elements(present: list[bool], seed: int) -> None:
    valid = torch.tensor([present, [True] * len(present)])
    samples = draw_samples(valid, 4, 20, seed)
    assert samples.shape == (2, 20, 4)
    assert all(len(set(sample)) == 4 for sample in samples.flatten(0, 1).tolist())
    if sum(present) >= 4:
        assert valid[0][samples[0]].all()
    assert torch.equal(draw_samples(valid, 4, 20, seed), samples)


def test_samples_are_spread_evenly() -> None:
    samples = draw_samples(torch.ones(50, dtype=torch.bool), 5, 2000, seed=0)
    counts = torch.bincount(samples.flatten(), minlength=50)
    assert counts.min() > 140 and counts.max() < 260  # 200 expected, 14 standard deviation


def test_gathered_samples_are_the_elements_at_the_indices() -> None:
    elements = torch.arange(12.0).reshape(1, 6, 2)
    assert gather_samples(elements, torch.tensor([[[5, 0]]])).tolist() == [[[[10.0, 11.0], [0.0, 1.0]]]]


def test_line_through_most_points_is_found() -> None:
    """Two problems: lines y = a x + b with a third of outliers, and points that are all padding."""
    x = torch.linspace(-1, 1, 30, dtype=torch.float64)
    y = 2 * x + 1
    y[::3] += 5.0
    points = torch.stack([x, y], dim=-1).expand(2, 30, 2)
    valid = torch.stack([torch.ones(30, dtype=torch.bool), torch.zeros(30, dtype=torch.bool)])

    def solve(samples: Tensor) -> Tensor:
        first, second = gather_samples(points, samples).unbind(dim=-2)
        slope = (second[..., 1] - first[..., 1]) / (second[..., 0] - first[..., 0])
        return torch.stack([slope, first[..., 1] - slope * first[..., 0]], dim=-1)[..., None, None, :]

    def squared_errors(lines: Tensor) -> Tensor:
        slope, offset = lines[..., 0, :, None].unbind(-2)
        return (points[..., None, :, 1] - slope * points[..., None, :, 0] - offset).square()

    default = torch.full((1, 2), 7.0, dtype=torch.float64)
    sampling = {"size": 2, "threshold": 0.1, "iterations": 100, "seed": 0}
    best, found = find_best_hypothesis(solve, squared_errors, valid, default, **sampling)
    torch.testing.assert_close(best[0], torch.tensor([[2.0, 1.0]], dtype=torch.float64))
    assert found.tolist() == [True, False] and torch.equal(best[1], default)
