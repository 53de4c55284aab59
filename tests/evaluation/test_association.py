"""Association of poses against the rule of the benchmark's tool."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from v3d_torch.evaluation.association import associate_trajectories
from v3d_torch.types import Trajectory


@given(seed=st.integers(0, 1000))
@settings(max_examples=30)
def test_association_is_one_to_one_and_nearest_first(seed: int) -> None:
    """Against the rule of the benchmark's associate.py as a plain loop."""
    generator = np.random.default_rng(seed)
    a, b = (np.unique(generator.uniform(0, 1, 40).round(3)) for _ in range(2))
    candidates = sorted((abs(x - y), i, j) for i, x in enumerate(a) for j, y in enumerate(b) if abs(x - y) < 0.0205)
    expected, used_a, used_b = [], set(), set()
    for _, i, j in candidates:
        if i not in used_a and j not in used_b:
            expected.append((i, j))
            used_a.add(i)
            used_b.add(j)
    estimate, groundtruth = (Trajectory(torch.from_numpy(s), torch.eye(4).expand(len(s), 4, 4)) for s in (a, b))
    matches = associate_trajectories(groundtruth, estimate, 0.0205)
    assert list(zip(matches.estimate.tolist(), matches.groundtruth.tolist(), strict=True)) == sorted(expected)
