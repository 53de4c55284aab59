"""RANSAC for the epipolar constraint between two images and for the pose from 3D points (paper, Sec. III-E)."""

from __future__ import annotations

import math
from collections.abc import Iterator

import kornia_rs
import torch
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import orthonormalise
from v3d_torch.optim.pose_refinement import refine_pose
from v3d_torch.optim.reprojection import CHI2_THRESHOLD_2D, Measurements

_MIN_EPIPOLAR_PAIRS = 8
"""Pairs that determine a fundamental matrix (eight-point algorithm)."""

_MIN_PNP_POINTS = 6
"""A sample of 5 points, and one more point that can confirm its pose."""

_SUBSET_SIZE = 100
"""Points in the first run of RANSAC, spaced evenly over all points, to save time: each hypothesis is tested on every
point. If no pose explains half of the points, a second run uses all of them, because a small subset has too few
inliers."""

_LOCAL_OPTIMISATION_INTERVAL = 5
"""Interval of the local optimisation, ``lo_every`` of kornia-rs (LO-RANSAC; Chum et al., DAGM 2003)."""


def epipolar_inliers(uv_a: Tensor, uv_b: Tensor, *, threshold: float, iterations: int, seed: int) -> Tensor:
    """Inliers of the fundamental matrix F, which satisfy the epipolar constraint x_b^T F x_a = 0.

    Args:
        uv_a: Undistorted pixels in image a, float64, shape :math:`(N, 2)`.
        uv_b: Undistorted pixels of the same points in image b, float64, shape :math:`(N, 2)`.
        threshold: Maximum Sampson distance of an inlier, pixels.
        iterations: Maximum number of hypotheses.
        seed: Seed of the sampling.

    Returns:
        Inlier mask, bool, shape :math:`(N,)`; all false for fewer than 8 pairs or if no matrix is found.
    """
    no_inliers = torch.zeros(uv_a.shape[0], dtype=torch.bool)
    if uv_a.shape[0] < _MIN_EPIPOLAR_PAIRS:
        return no_inliers
    pairs = torch.cat([uv_a, uv_b], dim=1).contiguous().numpy()
    try:
        result = kornia_rs.ransac.fundamental(pairs, threshold=threshold, max_iters=iterations, seed=seed)
    except ValueError:  # raised by kornia-rs if no sample gives a model
        return no_inliers
    return torch.tensor(result.inliers, dtype=torch.bool)


def pnp_ransac(
    points: Tensor,
    uv: Tensor,
    camera: PinholeCamera,
    *,
    threshold: float,
    iterations: int,
    seed: int,
    initial_guess: Tensor | None = None,
) -> tuple[Tensor, Tensor] | None:
    """Camera pose from 3D points and their pixels: EPnP in RANSAC, refined on all inliers.

    Args:
        points: Points in a frame "w", metres, float64, shape :math:`(N, 3)`.
        uv: Undistorted pixels of the points, float64, shape :math:`(N, 2)`.
        camera: Intrinsics.
        threshold: Maximum reprojection error of an inlier, pixels.
        iterations: Maximum number of hypotheses.
        seed: Seed of the sampling.
        initial_guess: Predicted ``T_cw``, float64, shape :math:`(4, 4)`. If the prediction, once refined, explains more
            than half of the points, RANSAC is skipped.

    Returns:
        Pose ``T_cw``, float64, shape :math:`(4, 4)`, and inlier mask, bool, shape :math:`(N,)`; None if no pose is
        found.
    """
    count = points.shape[0]
    if count < _MIN_PNP_POINTS:
        return None
    sigma = uv.new_full((count,), threshold / math.sqrt(CHI2_THRESHOLD_2D))
    # Residuals of pixels only: depth enters through the points.
    measured = Measurements(uv=uv, inverse_depth=uv.new_zeros(count), pixel_sigma=sigma, inverse_depth_sigma=1.0)

    def hypotheses() -> Iterator[Tensor]:
        if initial_guess is not None:
            yield initial_guess
        for size in sorted({min(_SUBSET_SIZE, count), count}):
            subset = torch.linspace(0, count - 1, size).round().to(torch.int64)
            T_cw = _sample_pose(points[subset], uv[subset], camera.K, threshold, iterations, seed)
            if T_cw is not None:
                yield T_cw

    pose = None
    for T_cw in hypotheses():
        refined = refine_pose(T_cw, points, measured, camera, rounds=2)
        pose = refined.T_cw, refined.inliers
        if 2 * int(refined.inliers.sum()) > count:
            break
    return pose


def _sample_pose(points: Tensor, uv: Tensor, K: Tensor, threshold: float, iterations: int, seed: int) -> Tensor | None:
    """Best pose ``T_cw`` of one RANSAC run, without refinement on all points; None if there is none."""
    try:
        R, t, _, _ = kornia_rs.k3d.solve_pnp_ransac(
            points.numpy(),
            uv.numpy(),
            K.numpy(),
            threshold=threshold,
            max_iterations=iterations,
            lo_every=_LOCAL_OPTIMISATION_INTERVAL,
            seed=seed,
        )
    except ValueError:  # raised by kornia-rs if no sample gives a pose
        return None
    T_cw = torch.eye(4, dtype=torch.float64)
    T_cw[:3, :3] = torch.from_numpy(R)
    T_cw[:3, 3] = torch.from_numpy(t).reshape(3)
    return orthonormalise(T_cw) if bool(torch.isfinite(T_cw).all()) else None
