"""RANSAC for the pose of a camera from 3D points and their pixels (paper, Sec. III-E)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import cv2
import torch
from torch import Tensor

from v3d_torch.features.p3p import solve_p3p
from v3d_torch.features.sampling import ITERATIONS, check_limits, find_best_hypothesis, gather_samples
from v3d_torch.features.usac import usac_options
from v3d_torch.geometry.argument_checks import check_masks
from v3d_torch.geometry.precision import result_dtype
from v3d_torch.geometry.se3 import orthonormalise, transform_points
from v3d_torch.geometry.settings_module import SettingsModule
from v3d_torch.kernels.compiler import can_read, is_all_true, to_array
from v3d_torch.optim.levenberg_marquardt import select
from v3d_torch.optim.pose_refinement import refine_pose
from v3d_torch.optim.reprojection import CHI2_THRESHOLD_2D, MIN_DEPTH
from v3d_torch.runtime.batches import check_shapes, mask_or_all

_MIN_PNP_POINTS = 6
"""Minimum number of points: a sample of 3, a point that selects one of its four poses, and points that confirm it."""


class PnP(NamedTuple):
    """Camera poses found by PnP-RANSAC.

    Attributes:
        T_cw: World-to-camera poses, shape :math:`(*, 4, 4)`; the identity if no pose was found.
        inliers: Mask of the points that agree with the pose, bool, shape :math:`(*, N)`.
        found: True if a pose was found that agrees with at least one point, bool, shape :math:`(*)`.
    """

    T_cw: Tensor
    inliers: Tensor
    found: Tensor


def pnp_ransac(
    points: Tensor,
    uv: Tensor,
    K: Tensor,
    initial_guess: Tensor | None = None,
    valid: Tensor | None = None,
    *,
    threshold: float = 4.0,
    iterations: int = ITERATIONS,
    seed: int = 0,
) -> PnP:
    """Estimate camera poses from 3D points and their pixels: PnP in RANSAC, refined on all inliers.

    The poses are differentiable in points, pixels and camera matrix, as those of :func:`refine_pose`; the inliers are
    constant. Hypotheses come from three points each (P3P). On the CPU, OpenCV computes them, one problem of the batch
    after the other. On other devices, and if `torch.func` traces the computation, torch computes them for the whole
    batch at once.

    Fischler and Bolles, Random Sample Consensus, CACM 1981; Raguram et al., USAC: A Universal Framework for Random
    Sample Consensus, PAMI 2013.

    Args:
        points: Points in a frame "w", metres, floating point, shape :math:`(*, N, 3)`.
        uv: Undistorted pixels of the points, shape :math:`(*, N, 2)`.
        K: Camera matrix, shape :math:`(*, 3, 3)`; its skew is ignored.
        initial_guess: Predicted ``T_cw``, shape :math:`(*, 4, 4)`; None, or NaN in a batch, if there is no prediction.
            If the refined prediction explains more than half of the points, RANSAC is skipped.
        valid: Mask of the points that are not padding, bool, shape :math:`(*, N)`; None for all. A point that is not
            finite, or whose pixel is not, counts as padding.
        threshold: Maximum reprojection error of an inlier, pixels.
        iterations: Maximum number of hypotheses.
        seed: Seed of the sampling.

    Returns:
        Poses with the dtype of ``points``, float32 for integers. No pose is found from fewer than 6 points.

    Raises:
        InputError: If ``valid`` is not bool, or if ``K`` can be read at once and is not that of a pinhole camera, see
            :func:`refine_pose`.
        ConfigError: If ``threshold`` or ``iterations`` is not positive, or ``iterations`` is not a whole number.
    """
    check_masks(valid=valid)
    check_limits(threshold, iterations)
    batch = check_shapes(
        points=(points, "N", 3), uv=(uv, "N", 2), K=(K, 3, 3), initial_guess=(initial_guess, 4, 4), valid=(valid, "N")
    )
    present = mask_or_all(valid, uv[..., 0]) & points.isfinite().all(dim=-1) & uv.isfinite().all(dim=-1)
    mask = present.expand(*batch, -1)
    count = mask.sum(dim=-1)
    data = (
        points.detach().to(torch.float64).expand(*batch, -1, 3),
        uv.detach().to(torch.float64).expand(*batch, -1, 2),
        K.detach().to(torch.float64).expand(*batch, 3, 3),
    )
    settings = threshold, iterations, seed
    sigma, dtype = threshold / math.sqrt(CHI2_THRESHOLD_2D), result_dtype(points.dtype)
    T_cw = torch.eye(4, dtype=dtype, device=points.device).expand(*batch, 4, 4)
    inliers, found, done = torch.zeros_like(mask), torch.zeros_like(count, dtype=torch.bool), count < _MIN_PNP_POINTS

    def hypotheses() -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Poses, a mask of the problems with a pose, and a mask of the points that refine it, (..., N)."""
        if initial_guess is not None:
            # The refined pose has the dtype of its prediction.
            predicted = initial_guess.detach().to(torch.float64).expand(*batch, 4, 4)
            exists = predicted.isfinite().all(dim=-1).all(dim=-1)
            # The result of another pose is not used, but NaN would reach the gradients.
            identity = torch.eye(4, dtype=predicted.dtype, device=predicted.device)
            yield torch.where(exists[..., None, None], predicted, identity), exists, mask
        if can_read(data[1]):
            best, exists = _sample_opencv(*data, mask & ~done[..., None], *settings)
        else:
            best, exists = _sample_torch(*data, mask, *settings)
        yield best, exists, _squared_errors(best, *data) <= threshold**2

    for hypothesis, exists, consensus in hypotheses():
        # Only pixels have residuals; the measured depth is already part of the points.
        weights = consensus.to(torch.float64)
        refined = refine_pose(hypothesis, points, uv, K, None, sigma, weights=weights, valid=valid, rounds=2)
        is_new = exists & ~done & (refined.inliers.sum(dim=-1) > inliers.sum(dim=-1))
        T_cw, inliers = select(is_new, (refined.T_cw.to(dtype), refined.inliers), (T_cw, inliers))
        found = found | is_new
        done = done | (is_new & (2 * inliers.sum(dim=-1) > count))
        if is_all_true(done):
            break
    return PnP(T_cw, inliers, found)


def _squared_errors(T_cw: Tensor, points: Tensor, uv: Tensor, K: Tensor) -> Tensor:
    """Squared reprojection errors, square pixels, (..., N); infinite for points behind the camera."""
    in_camera = transform_points(T_cw, points)
    xy = in_camera[..., :2] / in_camera[..., 2:].clamp(min=MIN_DEPTH)
    error = (xy * K.diagonal(dim1=-2, dim2=-1)[..., None, :2] + K[..., None, :2, 2] - uv).square().sum(dim=-1)
    return torch.where(in_camera[..., 2] > MIN_DEPTH, error, torch.inf)


def _sample_opencv(
    points: Tensor, uv: Tensor, K: Tensor, valid: Tensor, threshold: float, iterations: int, seed: int
) -> tuple[Tensor, Tensor]:
    """Best poses ``T_cw``, (..., 4, 4), of RANSAC in OpenCV, and a mask of the problems with a pose, (...).

    Problems with too few valid points are not solved.
    """
    poses = torch.eye(4, dtype=torch.float64).repeat(*valid.shape[:-1], 1, 1)
    found = torch.zeros(valid.shape[:-1], dtype=torch.bool)
    options = usac_options(threshold, iterations, seed)
    for row in (valid.sum(dim=-1) >= _MIN_PNP_POINTS).nonzero().tolist():
        index = tuple(row)
        X, x, matrix = (to_array(each) for each in (points[index][valid[index]], uv[index][valid[index]], K[index]))
        has_pose, _, rotation, t, _ = cv2.solvePnPRansac(X, x, matrix, None, params=options)
        if has_pose:
            T_cw = torch.eye(4, dtype=torch.float64)
            T_cw[:3, :3], T_cw[:3, 3:] = torch.from_numpy(cv2.Rodrigues(rotation)[0]), torch.from_numpy(t)
            found[index] = T_cw.isfinite().all()
            poses[index] = orthonormalise(T_cw) if found[index] else poses[index]
    return poses, found


def _sample_torch(
    points: Tensor, uv: Tensor, K: Tensor, valid: Tensor, threshold: float, iterations: int, seed: int
) -> tuple[Tensor, Tensor]:
    """Best poses ``T_cw``, (..., 4, 4), of RANSAC in torch, and a mask of the problems with a pose, (...)."""
    focal, centre = K.diagonal(dim1=-2, dim2=-1)[..., None, :2], K[..., None, :2, 2]
    xy = (uv - centre) / focal
    rays = torch.cat([xy, torch.ones_like(xy[..., :1])], dim=-1)
    by_hypothesis = points[..., None, :, :], uv[..., None, :, :], K[..., None, :, :]

    def solve(samples: Tensor) -> Tensor:
        return solve_p3p(gather_samples(points, samples), gather_samples(rays, samples))

    identity = torch.eye(4, dtype=points.dtype, device=points.device)
    return find_best_hypothesis(
        solve,
        lambda T_cw: _squared_errors(T_cw, *by_hypothesis),
        valid,
        identity,
        size=3,
        threshold=threshold,
        iterations=iterations,
        seed=seed,
    )


class PnPRANSAC(SettingsModule):
    """:func:`pnp_ransac` as a module.

    Args:
        threshold: Maximum reprojection error of an inlier, pixels.
        iterations: Maximum number of hypotheses.
        seed: Seed of the sampling.

    Raises:
        ConfigError: If a number is not possible; see :func:`pnp_ransac`.
    """

    def __init__(self, threshold: float = 4.0, iterations: int = ITERATIONS, seed: int = 0) -> None:
        check_limits(threshold, iterations)
        super().__init__()
        self.threshold = threshold
        self.iterations = iterations
        self.seed = seed

    def forward(
        self,
        points: Tensor,
        uv: Tensor,
        K: Tensor,
        initial_guess: Tensor | None = None,
        valid: Tensor | None = None,
    ) -> PnP:
        """Estimate poses from points :math:`(*, N, 3)` at pixels :math:`(*, N, 2)`; see :func:`pnp_ransac`."""
        return pnp_ransac(
            points,
            uv,
            K,
            initial_guess=initial_guess,
            valid=valid,
            threshold=self.threshold,
            iterations=self.iterations,
            seed=self.seed,
        )
