"""RANSAC for the fundamental matrix between two images (paper, Sec. III-E)."""

from __future__ import annotations

import kornia_rs
import torch
from torch import Tensor

_MIN_EPIPOLAR_PAIRS = 8
"""Minimum number of pairs for a fundamental matrix (eight-point algorithm)."""


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
