"""Least-squares problem of a bundle adjustment: residuals, normal equations, steps, derivatives of the optimum.

The observations are the last dimension of all tensors that have one value for each of them. An observation depends on
nine unknowns, the left perturbation of its pose and the shift of its point, and adds a 9x9 block to the normal
equations.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from v3d_torch.geometry.argument_checks import check_masks
from v3d_torch.geometry.gradients import without_second_derivatives, zero_with_gradient
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.kernels.compiler import can_read
from v3d_torch.optim.implicit import jacobian
from v3d_torch.optim.reprojection import (
    chi_square,
    perspective,
    perspective_jacobian,
    prepare_measurements,
    whiten,
)
from v3d_torch.optim.robust_losses import huber
from v3d_torch.optim.schur import NormalEquations, gather_columns, solve_normal_equations, sum_columns
from v3d_torch.runtime.batches import (
    check_camera_matrix,
    check_finite_arguments,
    check_shapes,
    fill_fixed,
    fill_indices,
    fill_weights,
)

NEGLIGIBLE_DAMPING = 1e-9
"""Damping of a full Gauss-Newton step, negligible relative to the diagonal."""

State = tuple[Tensor, Tensor]
"""Poses ``T_cw``, shape :math:`(..., P, 4, 4)`, and points, shape :math:`(..., L, 3)`."""


class BundleResiduals(NamedTuple):
    """Reprojection residuals of M observations at given poses and points.

    Attributes:
        in_camera: Observed points, camera frame, metres, shape :math:`(..., 3, M)`.
        projected: Observed points projected by `perspective`, shape :math:`(..., 3, M)`.
        R_cw: World-to-camera rotations, shape :math:`(..., 3, 3, M)`.
        whitened: Residuals divided by their standard deviations, shape :math:`(..., 3, M)`.
        weights: Weights in the normal equations: given weight times weight of Huber's loss, shape :math:`(..., M)`.
    """

    in_camera: Tensor
    projected: Tensor
    R_cw: Tensor
    whitened: Tensor
    weights: Tensor


class BundleProblem(NamedTuple):
    """M observations of L points by P poses; the measurements are whitened.

    Attributes:
        scale: Scale of the residuals, see `whiten`, shape :math:`(..., 3, M)`.
        offset: Offset of the residuals, shape :math:`(..., 3, M)`.
        thresholds: Squared residual at which Huber's loss turns linear, shape :math:`(..., M)`.
        weights: Weight of each observation, 0 for padding, shape :math:`(..., M)`.
        pose: Index of the pose of each observation, int64, shape :math:`(..., M)`.
        point: Index of the point of each observation, int64, shape :math:`(..., M)`.
        fixed: Mask of the poses that stay unchanged, bool, shape :math:`(..., P)`.
    """

    scale: Tensor
    offset: Tensor
    thresholds: Tensor
    weights: Tensor
    pose: Tensor
    point: Tensor
    fixed: Tensor

    def detach(self) -> BundleProblem:
        """Return the problem without gradients."""
        return BundleProblem(*(column.detach() for column in self))

    def residuals_at(self, state: State) -> tuple[Tensor, BundleResiduals]:
        """Robust cost at poses and points, shape :math:`(...)`, and the residuals."""
        return self._observe(*self._gather(state))

    def chi2(self, residuals: BundleResiduals) -> Tensor:
        """Squared whitened residual of each observation, shape :math:`(..., M)`; infinite behind the camera."""
        return chi_square(residuals.in_camera.mT, residuals.whitened.mT)

    def linearise(self, residuals: BundleResiduals, point_count: int) -> NormalEquations:
        """Normal equations of the robust cost of ``point_count`` points, linearised at the given residuals."""
        J = self._jacobian(residuals)
        weighted = J * residuals.weights[..., None, None, :]
        blocks = (weighted[..., :, None, :, :] * J[..., None, :, :, :]).sum(dim=-2)
        return self._assemble(blocks, (weighted * residuals.whitened[..., None, :, :]).sum(dim=-2), point_count)

    def remaining(self, residuals: BundleResiduals, derivative: Tensor, point_count: int) -> Tensor:
        r"""Part of a change of the residuals that no change of poses and points explains.

        With the Jacobian :math:`J` with respect to poses and points, the remaining part of a change :math:`j` of the
        residuals is :math:`j - J (J^T W J)^{-1} J^T W j`. Twice its products with :math:`W r` and :math:`W j` are
        the derivatives of the minimum cost (Triggs et al., Bundle Adjustment - A Modern Synthesis, 2000).

        Args:
            residuals: Residuals at the poses and points of the linearisation.
            derivative: First-order changes of the whitened residuals, shape :math:`(*, ..., 3, M)`; a problem can have
                several changes.
            point_count: Number of points.

        Returns:
            Shape :math:`(*, ..., 3, M)`.
        """
        change = self.linearise(residuals._replace(whitened=derivative), point_count)
        xi, delta = solve_normal_equations(change, NEGLIGIBLE_DAMPING)
        none = xi.new_zeros(*xi.shape[:-1], 1)
        of_pose = gather_columns(torch.cat([xi, none], dim=-1), change.pose)
        steps = torch.cat([of_pose, gather_columns(delta, self.point)], dim=-2)
        return derivative + (self._jacobian(residuals) * steps[..., None, :]).sum(dim=-3)

    def step(self, state: State, residuals: BundleResiduals, damping: Tensor | float) -> State:
        """State after a damped Gauss-Newton step from the given state and its residuals."""
        return self._move(state, solve_normal_equations(self.linearise(residuals, state[1].shape[-2]), damping))

    def differentiate(self, state: State, T_cw: Tensor) -> State:
        """Return the optimum ``state`` with derivatives.

        They are those with respect to the measurements, the weights and the fixed poses in ``T_cw``.
        """
        constant = self.detach()
        T, X = constant._gather(state)

        def gradient(change: Tensor) -> Tensor:
            E = se3_exp(change[..., :6]).movedim(-3, -1)
            moved = (E[..., :3, :3, None, :] * T[..., None, :, :, :]).sum(dim=-3)
            moved = moved + E[..., :3, 3:, :] * moved.new_tensor([0.0, 0.0, 0.0, 1.0])[:, None]
            return constant._gradient(moved, X + change[..., 6:].mT).mT

        blocks = jacobian(gradient, T.new_zeros(*X.shape[:-2], X.shape[-1], 9)).movedim(-3, -1)
        anchored = torch.where(self.fixed[..., None, None], T_cw, state[0])
        problem = BundleProblem(*map(without_second_derivatives, self))
        right = problem._gradient(*problem._gather((without_second_derivatives(anchored), state[1])))
        steps = solve_normal_equations(self._assemble(blocks, right, state[1].shape[-2]), 0.0)
        return self._move((anchored, state[1]), (zero_with_gradient(steps[0]), zero_with_gradient(steps[1])))

    @property
    def _rows(self) -> tuple[Tensor, int]:
        """Index of each pose among the free poses, (..., P), and their number F, the index of fixed poses."""
        free = ~self.fixed
        count = int(free.sum(dim=-1).max()) if can_read(free) and free.numel() else free.shape[-1]
        return torch.where(free, free.cumsum(dim=-1) - 1, count), count

    def _gather(self, state: State) -> State:
        """Poses (..., 3, 4, M) and points (..., 3, M) of the observations."""
        T_cw, points = state
        T = gather_columns(T_cw[..., :3, :].flatten(-2).mT, self.pose).unflatten(-2, (3, 4))
        return T, gather_columns(points.mT, self.point)

    def _observe(self, T: Tensor, X: Tensor) -> tuple[Tensor, BundleResiduals]:
        R = T[..., :3, :]
        in_camera = (R * X[..., None, :, :]).sum(dim=-2) + T[..., 3, :]
        projected = perspective(in_camera)
        whitened = torch.addcmul(self.offset, self.scale, projected)
        costs, weights = huber((whitened * whitened).sum(dim=-2), self.thresholds)
        cost = (costs * self.weights).sum(dim=-1)
        return cost, BundleResiduals(in_camera, projected, R, whitened, weights * self.weights)

    def _jacobian(self, residuals: BundleResiduals) -> Tensor:
        """Derivatives of whitened residuals with respect to the nine unknowns of an observation, (..., 9, 3, M)."""
        by_pose = perspective_jacobian(residuals.projected) * self.scale[..., None, :, :]
        by_point = (residuals.R_cw[..., :, :, None, :] * by_pose[..., :3, None, :, :]).sum(dim=-4)
        return torch.cat([by_pose, by_point], dim=-3)

    def _gradient(self, T: Tensor, X: Tensor) -> Tensor:
        """Half the gradient of the cost by the nine unknowns of each observation, (..., 9, M)."""
        _, residuals = self._observe(T, X)
        weighted = residuals.whitened * residuals.weights[..., None, :]
        return (self._jacobian(residuals) * weighted[..., None, :, :]).sum(dim=-2)

    def _assemble(self, blocks: Tensor, gradient: Tensor, point_count: int) -> NormalEquations:
        """Normal equations of the blocks (..., 9, 9, M) and gradients (*, ..., 9, M) of all observations."""
        rows, free = self._rows
        row = rows.gather(-1, self.pose)
        return NormalEquations(
            U=sum_columns(blocks[..., :6, :6, :].flatten(-3, -2), row, free).unflatten(-2, (6, 6)),
            V=sum_columns(blocks[..., 6:, 6:, :].flatten(-3, -2), self.point, point_count).unflatten(-2, (3, 3)),
            W=blocks[..., 6:, :6, :],
            pose_gradient=sum_columns(gradient[..., :6, :], row, free),
            point_gradient=sum_columns(gradient[..., 6:, :], self.point, point_count),
            pose=row,
            point=self.point,
        )

    def _move(self, state: State, steps: tuple[Tensor, Tensor]) -> State:
        """Apply the steps of `solve_normal_equations` to the free poses and the points."""
        (T_cw, points), (pose_step, point_step) = state, steps
        none = pose_step.new_zeros(*pose_step.shape[:-1], 1)
        xi = gather_columns(torch.cat([pose_step, none], dim=-1), self._rows[0]).mT
        moved = torch.where(self.fixed[..., None, None], T_cw, se3_exp(xi) @ T_cw)
        return moved, points + point_step.mT


def prepare_bundle(
    T_cw: Tensor,
    points: Tensor,
    uv: Tensor,
    pose: Tensor,
    point: Tensor,
    K: Tensor,
    inverse_depth: Tensor | None,
    pixel_sigma: Tensor | float,
    inverse_depth_sigma: Tensor | float,
    fixed: Tensor | None,
    weights: Tensor | None,
    valid: Tensor | None,
) -> tuple[BundleProblem, State, Tensor]:
    """Prepare the arguments of `bundle_adjust`.

    Returns:
        The problem and the initial state, in float64, and the mask of the observations that are not padding, bool,
        shape :math:`(..., M)`.

    Raises:
        InputError: If a mask is not bool, an index is not int64 or out of range, a pose or point is not finite, a
            weight is negative, infinite or NaN, a standard deviation in a tensor is not positive, or a camera matrix is
            not that of a pinhole camera.
        ConfigError: If a standard deviation that is a number is not positive.
    """
    check_masks(fixed=fixed, valid=valid)
    batch = check_shapes(
        T_cw=(T_cw, "P", 4, 4),
        points=(points, "L", 3),
        pose=(pose, "M"),
        uv=(uv, "M", 2),
        point=(point, "M"),
        K=(K, 3, 3),
        inverse_depth=(inverse_depth, "M"),
        pixel_sigma=(pixel_sigma, None),
        inverse_depth_sigma=(inverse_depth_sigma, None),
        fixed=(fixed, "P"),
        weights=(weights, "M"),
        valid=(valid, "M"),
    )
    check_finite_arguments(T_cw=T_cw, points=points)
    check_camera_matrix(K)
    finite = uv.isfinite().all(dim=-1)  # others would make every step NaN
    valid = finite if valid is None else finite & valid
    measured = prepare_measurements(uv, inverse_depth, pixel_sigma, inverse_depth_sigma, valid)
    target = whiten(measured, K.to(torch.float64))
    fixed = fill_fixed(fixed, T_cw)
    pose = fill_indices("pose", pose, T_cw.shape[-3], valid)
    point = fill_indices("point", point, points.shape[-2], valid)
    each = (*batch, pose.shape[-1])  # observation
    problem = BundleProblem(
        scale=target.scale.expand(*batch, 3, -1),
        offset=target.offset.expand(*batch, 3, -1),
        thresholds=measured.chi2_threshold.expand(each),
        weights=fill_weights(weights, valid).expand(each),
        pose=pose.expand(each),
        point=point.expand(each),
        fixed=fixed.expand(*batch, T_cw.shape[-3]),
    )
    state = T_cw.to(torch.float64).expand(*batch, *T_cw.shape[-3:]), points.to(torch.float64)
    return problem, (state[0], state[1].expand(*batch, *points.shape[-2:])), valid
