r"""Minimum cost of a bundle adjustment over poses and points, as a function of parameters of the camera.

Let :math:`J` be the Jacobian of the residuals :math:`r` with respect to poses and points, and :math:`j` their
derivatives with respect to the parameters. When the parameters change by :math:`\delta`, the adjusted poses and points
change by :math:`-(J^T W J)^{-1} J^T W j\, \delta`, which explains a part of the change of the residuals. The part that
remains, :math:`\tilde j = j - J (J^T W J)^{-1} J^T W j`, gives the derivatives of the minimum cost:
:math:`2 \tilde j^T W r` and :math:`2 \tilde j^T W \tilde j`. The latter is twice the Schur complement of poses and
points, the information on the parameters when poses and points are unknown (Triggs et al., Bundle Adjustment - A Modern
Synthesis, 2000).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.kernels import bundle_adjustment as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array
from v3d_torch.mapping.bundle_adjustment import BundleProblem, Observations, sort_by_point
from v3d_torch.optim.reprojection import MIN_DEPTH
from v3d_torch.optim.schur import REGULARISATION, solve_normal_equations

_NEGLIGIBLE_DAMPING = 1e-9
"""Damping of a full Gauss-Newton step, negligible relative to the diagonal."""


@torch.no_grad()
def reduced_cost_derivatives(
    T_cw: Tensor,
    points: Tensor,
    observations: Observations,
    camera: PinholeCamera,
    fixed: Tensor,
    jacobian: Tensor,
) -> tuple[Tensor, Tensor]:
    """Derivatives of the minimum cost of a bundle adjustment, as sums over the observations of each pose.

    Args:
        T_cw: World-to-camera poses, float64, shape :math:`(K, 4, 4)`.
        points: Positions of the landmarks, world frame, metres, float64, shape :math:`(P, 3)`.
        observations: Observations of the points by the poses.
        camera: Intrinsics.
        fixed: True for poses that stay unchanged, bool, shape :math:`(K,)`.
        jacobian: Derivatives of the whitened residuals with respect to C parameters, float64, shape
            :math:`(M, 3, C)`.

    Returns:
        First derivatives, shape :math:`(K, C)`, and second derivatives, shape :math:`(K, C, C)`. Their sums over the
        poses are the derivatives of the minimum cost. Poses and points need not be at the minimum.
    """
    problem = BundleProblem(observations, camera, fixed, len(points))
    residuals = problem.residuals_at((T_cw, points))[1]
    columns = jacobian[problem.order].permute(2, 1, 0)
    remaining = problem.remaining(residuals, columns, _NEGLIGIBLE_DAMPING)
    weighted = 2 * residuals.weights * remaining
    pose = observations.pose[problem.order]
    gradient = torch.einsum("cim,im->mc", weighted, residuals.whitened)
    hessian = torch.einsum("cim,dim->mcd", weighted, remaining)
    K, C = len(T_cw), len(columns)
    return (
        gradient.new_zeros(K, C).index_add_(0, pose, gradient),
        hessian.new_zeros(K, C, C).index_add_(0, pose, hessian),
    )


def _readout_cost_derivatives_compiled(
    T_cw: Tensor,
    points: Tensor,
    observations: Observations,
    camera: PinholeCamera,
    fixed: Tensor,
    uv_jacobian: Tensor,
) -> tuple[float, float]:
    if T_cw.dtype != torch.float64 or points.dtype != torch.float64:
        return NotImplemented
    order, problem = sort_by_point(observations, camera, fixed, len(points))
    derivative = np.zeros((len(order), 3))
    derivative[:, :2] = to_array(-uv_jacobian / observations.pixel_sigma[:, None])[order]
    return kernels.reduced_cost_derivatives(
        to_array(T_cw), to_array(points), *problem, derivative, _NEGLIGIBLE_DAMPING, REGULARISATION, MIN_DEPTH
    )


@torch.no_grad()
@compiled_by(_readout_cost_derivatives_compiled)
def readout_cost_derivatives(
    T_cw: Tensor,
    points: Tensor,
    observations: Observations,
    camera: PinholeCamera,
    fixed: Tensor,
    uv_jacobian: Tensor,
) -> tuple[float, float]:
    """Derivatives of the minimum cost of a bundle adjustment with respect to one parameter of the measured pixels.

    Args:
        T_cw: World-to-camera poses at the minimum, float64, shape :math:`(K, 4, 4)`.
        points: Positions of the landmarks at the minimum, world frame, metres, float64, shape :math:`(P, 3)`.
        observations: Observations of the points by the poses.
        camera: Intrinsics.
        fixed: True for poses that stay unchanged, bool, shape :math:`(K,)`.
        uv_jacobian: Derivative of the measured pixels with respect to the parameter, float64, shape :math:`(M, 2)`.

    Returns:
        First and second derivative of the minimum cost with respect to the parameter.
    """
    problem = BundleProblem(observations, camera, fixed, len(points))
    residuals = problem.residuals_at((T_cw, points))[1]
    j = torch.zeros_like(residuals.whitened)
    j[:2] = (-uv_jacobian / observations.pixel_sigma[:, None])[problem.order].T
    change = problem.linearise(residuals, j[None])
    pose_step, point_step = solve_normal_equations(change, _NEGLIGIBLE_DAMPING)
    first, second = (  # j^T W r without the part that the step explains, and the same for j in place of r
        float(
            (residuals.weights * j * each).sum()
            + (pose_step * equations.U[..., 6:]).sum()
            + (point_step.permute(1, 2, 0) * equations.V[:, 3:]).sum()
        )
        for each, equations in ((residuals.whitened, residuals.normal_equations), (j, change))
    )
    return 2 * first, 2 * second
