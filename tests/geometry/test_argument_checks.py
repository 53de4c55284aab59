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


NONE_VALID = torch.zeros(2, 5, dtype=torch.int64), PRESENT
DESCRIPTORS = torch.zeros(2, 3, 32, dtype=torch.uint8)


@pytest.mark.parametrize(
    ("name", "function"),
    [
        ("min_samples", lambda value: v3d.dbscan(CLOUD, PRESENT, 0.1, value)),
        ("min_samples", lambda value: v3d.DBSCAN(0.1, value)),
        ("radius", lambda value: v3d.surface_normals(torch.ones(1, 9, 9, 3), value)),
        ("radius", lambda value: v3d.surface_normals(torch.ones(1, 9, 9, 3).double(), value)),
        ("n", lambda value: v3d.largest_clusters(*NONE_VALID, value)),
        ("min_points", lambda value: v3d.largest_clusters(*NONE_VALID, min_points=value)),
        ("min_points", v3d.LargestClusters),
        ("max_hamming", lambda value: v3d.match_descriptors(DESCRIPTORS, DESCRIPTORS, max_hamming=value)),
        ("max_hamming", v3d.DescriptorMatcher),
        ("rounds", lambda value: v3d.PoseRefiner(rounds=value)),
        ("iterations", lambda value: v3d.PoseRefiner(iterations=value)),
        ("iterations", lambda value: v3d.BundleAdjuster(iterations=value)),
        ("iterations", v3d.PoseGraphOptimiser),
        ("iterations", lambda value: v3d.PnPRANSAC(iterations=value)),
        ("iterations", lambda value: v3d.EssentialRANSAC(iterations=value)),
    ],
)
@pytest.mark.parametrize("value", [2.5, 3.0])
def test_number_with_decimals_instead_of_a_whole_number_is_an_error(
    name: str, function: Callable[[float], object], value: float
) -> None:
    """The kernels cut off the decimals; the torch functions raised other errors, or did not."""
    with pytest.raises(ConfigError, match=f"^{name} is {value}; give a whole number of at least 0$"):
        function(value)
    function(np.int64(3))


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("kernel_size", lambda: v3d.DepthSmoother(4)),
        ("kernel_size", lambda: v3d.DepthSmoother(5.0)),  # type: ignore[arg-type]
        ("size", lambda: v3d.VoxelPool(-1)),
        ("dbscan: eps", lambda: v3d.DBSCAN(-1, 1)),
        ("dbscan: eps is 1 and min_samples", lambda: v3d.DBSCAN(1, 0)),
        ("n", lambda: v3d.largest_clusters(*NONE_VALID, -1)),
        ("min_points", lambda: v3d.LargestClusters(-1)),
        ("distance_threshold", lambda: v3d.HoughVoting(-1, 2)),
        ("hough_vote: temperature", lambda: v3d.HoughVoting(0.1, 2, 0.0)),
        ("distance_threshold", lambda: v3d.IntraObjectMotion(-1)),
        ("max_ratio", lambda: v3d.DescriptorMatcher(64, math.nan)),
        ("threshold", lambda: v3d.PnPRANSAC(-1)),
        ("threshold", lambda: v3d.EssentialRANSAC(0)),
        ("pixel_sigma", lambda: v3d.PoseRefiner(-1)),
        ("inverse_depth_sigma", lambda: v3d.BundleAdjuster(inverse_depth_sigma=0)),
        ("pixel_sigma", lambda: v3d.ReadoutEstimator(math.nan)),
        ("robust", lambda: v3d.PoseGraphOptimiser(robust=0)),
        ("delta", lambda: v3d.RelativePoseError(0)),
        ("height", lambda: v3d.RollingShutterCompensation(0.01, 1)),
    ],
)
def test_module_with_a_setting_that_is_not_possible_is_an_error(name: str, make: Callable[[], object]) -> None:
    """Modules raised it at the first call."""
    with pytest.raises(ConfigError, match=f"^{name} is .*; give "):
        make()


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
