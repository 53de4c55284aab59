"""Thresholds that are not possible are errors that name the argument."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

import v3d_torch as v3d
from v3d_torch.errors import ConfigError

CLOUD = torch.rand(2, 5, 3, generator=torch.Generator().manual_seed(0))
PRESENT = torch.ones(2, 5, dtype=torch.bool)


@pytest.mark.parametrize(
    ("name", "function"),
    [
        ("edge_ratio", lambda value: v3d.smooth_depth(torch.ones(1, 1, 4, 4), edge_ratio=value)),
        ("edge_ratio", lambda value: v3d.smooth_depth(torch.ones(1, 1, 4, 4).double(), edge_ratio=value)),
        ("edge_ratio", lambda value: v3d.surface_normals(torch.ones(1, 9, 9, 3), edge_ratio=value)),
        ("edge_ratio", lambda value: v3d.surface_normals(torch.ones(1, 9, 9, 3).double(), edge_ratio=value)),
        ("distance_threshold", lambda value: v3d.hough_vote(CLOUD, CLOUD, PRESENT, value, 1)),
        ("vote_threshold", lambda value: v3d.hough_vote(CLOUD, CLOUD, PRESENT, 0.1, value)),
        ("distance_threshold", lambda value: v3d.intra_object_motion(CLOUD, CLOUD, value)),
    ],
)
@pytest.mark.parametrize("value", [-0.1, math.nan])
def test_threshold_that_is_negative_or_nan_is_an_error(
    name: str, function: Callable[[float], Tensor], value: float
) -> None:
    """All comparisons with it were false: no surface had neighbours, and nothing ever moved."""
    with pytest.raises(ConfigError, match=f"^{name} is {value}; give a number of at least 0$"):
        function(value)
    for possible in (0.0, math.inf):
        function(possible)
