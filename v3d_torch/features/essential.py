r"""Essential matrices between two views, by RANSAC and refinement of the Sampson distance.

With the normalised coordinates :math:`x_a, x_b` of a point in both images, :math:`x_b^\top E\, x_a = 0`, where
:math:`E = [t]_\times R` for the motion :math:`T_{ba} = (R, t)`.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from v3d_torch.features.sampling import ITERATIONS, check_limits, find_best_hypothesis, gather_samples
from v3d_torch.features.sampson import EpipolarProblem, compose, decompose, refine_essential
from v3d_torch.features.usac import usac_options
from v3d_torch.geometry.argument_checks import check_masks
from v3d_torch.geometry.gradients import needs_gradient
from v3d_torch.geometry.precision import result_dtype
from v3d_torch.geometry.settings_module import SettingsModule
from v3d_torch.kernels.compiler import can_read, to_array
from v3d_torch.runtime.batches import check_shapes, fill_padding, fill_weights, mask_or_all

_MIN_PAIRS = 6
"""Minimum number of pairs: a sample of 5, and one more pair that can confirm its matrix."""


class EssentialMatrix(NamedTuple):
    """Essential matrices found by RANSAC.

    Attributes:
        E: Essential matrices, of unit Frobenius norm, shape :math:`(*, 3, 3)`; 0 if none was found.
        inliers: Mask of the pairs that satisfy the epipolar constraint, bool, shape :math:`(*, N)`.
        found: True if a matrix was found, bool, shape :math:`(*)`.
    """

    E: Tensor
    inliers: Tensor
    found: Tensor


def essential_ransac(
    uv_a: Tensor,
    uv_b: Tensor,
    K: Tensor,
    weights: Tensor | None = None,
    valid: Tensor | None = None,
    *,
    threshold: float = 1.0,
    iterations: int = ITERATIONS,
    seed: int = 0,
) -> EssentialMatrix:
    """Estimate essential matrices from pairs of pixels: RANSAC, refined by the Sampson distance of all inliers.

    The matrices are differentiable in pixels, camera matrix and weights, by the implicit function theorem; the inliers
    are constant. There are no second derivatives: autograd raises an InputError, and those of `torch.func` are not
    correct. On the CPU, OpenCV computes the hypotheses by the five-point algorithm, one problem of the batch
    after the other. On other devices, and if `torch.func` traces the computation, torch computes them for the whole
    batch at once by the eight-point algorithm, which fails if all points lie in a plane.

    If the camera did not move, or only turned, each matrix of some family fits all pairs, and one of them is returned.
    `kornia.geometry.motion_from_essential_choose_solution` gives the motion, up to the length of its translation.

    Nister, An Efficient Solution to the Five-Point Relative Pose Problem, PAMI 2004; Hartley and Zisserman, Multiple
    View Geometry, 2004, Sec. 9.6 and 11.4.

    Args:
        uv_a: Undistorted pixels in image a, floating point, shape :math:`(*, N, 2)`.
        uv_b: Undistorted pixels of the same points in image b, shape :math:`(*, N, 2)`.
        K: Camera matrix of both images, shape :math:`(*, 3, 3)`.
        weights: Weight of each pair in the refinement, not negative, shape :math:`(*, N)`; None for 1.
        valid: Mask of the pairs that are not padding, bool, shape :math:`(*, N)`; None for all. A pair with a pixel
            that is not finite counts as padding.
        threshold: Maximum Sampson distance of an inlier, pixels.
        iterations: Maximum number of hypotheses.
        seed: Seed of the sampling.

    Returns:
        Matrices with the dtype of ``uv_a``, float32 for integers; their sign is arbitrary. No matrix is found from
        fewer than 6 pairs (8 if torch computes the hypotheses), or if ``K`` is singular, as for padding.

    Raises:
        InputError: If ``valid`` is not bool, or a weight is negative, infinite or NaN.
        ConfigError: If ``threshold`` or ``iterations`` is not positive, or ``iterations`` is not a whole number.
    """
    check_masks(valid=valid)
    check_limits(threshold, iterations)
    batch = check_shapes(
        uv_a=(uv_a, "N", 2), uv_b=(uv_b, "N", 2), K=(K, 3, 3), weights=(weights, "N"), valid=(valid, "N")
    )
    valid = mask_or_all(valid, uv_a[..., 0]) & uv_a.isfinite().all(dim=-1) & uv_b.isfinite().all(dim=-1)
    weights = fill_weights(weights, valid)
    K = K.to(torch.float64)
    is_regular = torch.linalg.det(K.detach()).abs()[..., None] > 0  # false for NaN, too
    K = torch.where(is_regular[..., None], K, torch.eye(3, dtype=K.dtype, device=K.device))
    mask, row = (valid & is_regular).expand(*batch, -1), valid[..., None]
    problem = EpipolarProblem(
        a=_homogeneous(fill_padding(uv_a, row, 0.0).expand(*batch, -1, 2)),
        b=_homogeneous(fill_padding(uv_b, row, 0.0).expand(*batch, -1, 2)),
        K_inverse=torch.linalg.inv(K).expand(*batch, 3, 3),
        weights=weights.expand(*batch, -1),
    )
    constant = EpipolarProblem(*(each.detach() for each in problem))
    with torch.no_grad():
        sample = _sample_five_points if can_read(constant.a) else _sample_eight_points
        hypothesis, found = sample(constant, mask, threshold, iterations, seed)
        found = found & (mask.sum(dim=-1) >= _MIN_PAIRS)
        state, inliers, active = refine_essential(hypothesis, constant, mask & found[..., None], threshold)
    if needs_gradient(*problem):
        state = problem.differentiate(state, active)
    E = torch.where(found[..., None, None], compose(*state), 0.0)
    return EssentialMatrix(E.to(result_dtype(uv_a.dtype)), inliers, found)


def _sample_five_points(
    problem: EpipolarProblem, valid: Tensor, threshold: float, iterations: int, seed: int
) -> tuple[Tensor, Tensor]:
    """Best essential matrices of OpenCV, (..., 3, 3), and a mask of the problems with a matrix, (...)."""
    focal = 1 / problem.K_inverse.diagonal(dim1=-2, dim2=-1)[..., :2].prod(dim=-1).sqrt()
    a, b = ((each @ problem.K_inverse.mT)[..., :2] for each in (problem.a, problem.b))
    E = torch.eye(3, dtype=torch.float64).repeat(*valid.shape[:-1], 1, 1)
    found, identity = torch.zeros(valid.shape[:-1], dtype=torch.bool), np.eye(3)
    for row in (valid.sum(dim=-1) >= _MIN_PAIRS).nonzero().tolist():
        index = tuple(row)
        options = usac_options(threshold / float(focal[index]), iterations, seed)
        pair = to_array(a[index][valid[index]]), to_array(b[index][valid[index]])
        best, _ = cv2.findEssentialMat(*pair, identity, identity, None, None, options)
        if best is not None and np.isfinite(best).all():
            E[index], found[index] = torch.from_numpy(best[:3]), True
    return E, found


def _sample_eight_points(
    problem: EpipolarProblem, valid: Tensor, threshold: float, iterations: int, seed: int
) -> tuple[Tensor, Tensor]:
    """Best essential matrices of RANSAC in torch, (..., 3, 3), and a mask of the problems with a matrix, (...)."""
    a, b = (each @ problem.K_inverse.mT for each in (problem.a, problem.b))
    by_hypothesis = {name: getattr(problem, name)[..., None, :, :] for name in ("a", "b", "K_inverse")}

    def solve(samples: Tensor) -> Tensor:
        products = (gather_samples(b, samples)[..., :, None] * gather_samples(a, samples)[..., None, :]).flatten(-2)
        smallest = torch.linalg.eigh(products.mT @ products).eigenvectors[..., 0]
        return compose(*decompose(smallest.unflatten(-1, (3, 3))))[..., None, :, :]

    def squared_errors(E: Tensor) -> Tensor:
        return problem._replace(**by_hypothesis).sampson(E).square()

    identity = torch.eye(3, dtype=a.dtype, device=a.device)
    return find_best_hypothesis(
        solve,
        squared_errors,
        valid,
        identity,
        size=8,
        threshold=threshold,
        iterations=iterations,
        seed=seed,
    )


def _homogeneous(uv: Tensor) -> Tensor:
    return torch.cat([uv, torch.ones_like(uv[..., :1])], dim=-1)


class EssentialRANSAC(SettingsModule):
    """:func:`essential_ransac` as a module.

    Args:
        threshold: Maximum Sampson distance of an inlier, pixels.
        iterations: Maximum number of hypotheses.
        seed: Seed of the sampling.

    Raises:
        ConfigError: If a number is not possible; see :func:`essential_ransac`.
    """

    def __init__(self, threshold: float = 1.0, iterations: int = ITERATIONS, seed: int = 0) -> None:
        check_limits(threshold, iterations)
        super().__init__()
        self.threshold = threshold
        self.iterations = iterations
        self.seed = seed

    def forward(
        self,
        uv_a: Tensor,
        uv_b: Tensor,
        K: Tensor,
        weights: Tensor | None = None,
        valid: Tensor | None = None,
    ) -> EssentialMatrix:
        """Estimate matrices from pixels :math:`(*, N, 2)` in two images; see :func:`essential_ransac`."""
        return essential_ransac(
            uv_a, uv_b, K, weights, valid, threshold=self.threshold, iterations=self.iterations, seed=self.seed
        )
