"""Thresholds that are not possible and wrong shapes are errors that name the argument."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from kornia.core.check import disable_checks, enable_checks
from kornia.core.exceptions import ShapeError
from torch import Tensor

import v3d_torch as v3d
from v3d_torch.errors import ConfigError, InputError

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


@pytest.mark.parametrize("enabled", [True, False])
@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda: v3d.dbscan(CLOUD[0], PRESENT[0], 0.1, 3), r"points has the shape \(5, 3\); .* of shape \(B, N, 3\)"),
        (lambda: v3d.dbscan(CLOUD, PRESENT[:, :4], 0.1, 3), r"valid has the shape \(2, 4\); .* of shape \(2, 5\)"),
        (lambda: v3d.se3_exp(torch.zeros(4, 5)), r"xi has the shape \(4, 5\); .* of shape \(\.\.\., 6\)"),
        (lambda: v3d.se3_log(torch.zeros(4)), r"T has the shape \(4,\); .* of shape \(\.\.\., 4, 4\)"),
        (lambda: v3d.chamfer_distance(CLOUD, CLOUD[:1]), r"q has the shape \(1, 5, 3\); .* of shape \(2, M, 3\)"),
        (
            lambda: v3d.chamfer_distance(CLOUD, CLOUD, q_valid=PRESENT[:, :1]),
            r"q_valid has the shape \(2, 1\); .* of shape \(2, 5\)",
        ),
        (lambda: v3d.hough_vote(CLOUD, CLOUD[:, 1:], PRESENT, 0.1, 1), r"current has the shape \(2, 4, 3\); .*"),
    ],
)
def test_error_of_a_shape_names_the_argument(function: Callable[[], Tensor], message: str, enabled: bool) -> None:
    """Also if Kornia's checks are disabled, as `python -O` does."""
    if not enabled:
        disable_checks()
    try:
        with pytest.raises(ShapeError, match=f"^{message}$") as caught:
            function()
        assert str(tuple(caught.value.actual_shape)) in str(caught.value)
    finally:
        enable_checks()


def test_array_instead_of_a_tensor_is_an_error() -> None:
    with pytest.raises(InputError, match=r"^xi is of type ndarray; give a torch.Tensor of shape \(\.\.\., 6\)$"):
        v3d.se3_exp(np.zeros((4, 6)))  # type: ignore[arg-type]
