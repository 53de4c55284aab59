"""Bundle adjustment: joint optimisation of keyframe poses and landmarks (ORB-SLAM2, local mapping).

Levenberg-Marquardt minimises robust errors of pixels and inverse depth. Landmarks are eliminated by the Schur
complement (Triggs et al., "Bundle Adjustment - A Modern Synthesis", 2000); the reduced system, with 6 unknowns per
pose, is solved densely.

Convention: poses ``T_cw`` are perturbed on the left, ``exp(xi) @ T_cw``, with ``xi = [translation, rotation]``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.kernels import bundle_adjustment as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array
from v3d_torch.optim.levenberg_marquardt import DAMPING_SCHEDULE, huber, levenberg_marquardt
from v3d_torch.optim.reprojection import (
    MIN_DEPTH,
    Measurements,
    WhitenedMeasurements,
    chi_square,
    perspective,
    perspective_jacobian,
    whiten,
)
from v3d_torch.optim.schur import REGULARISATION, NormalEquations, gather_columns, solve_normal_equations

_Array = NDArray[Any]

SortedProblem = tuple[_Array, _Array, _Array, _Array, _Array, _Array]
"""Scale, offset, chi-square threshold and pose of the observations sorted by point; first observation of each point;
free poses."""

State = tuple[Tensor, Tensor]
"""Poses ``T_cw``, shape :math:`(K, 4, 4)`, and points, shape :math:`(P, 3)`."""


@dataclass(frozen=True, kw_only=True)
class Observations(Measurements):
    """Measurements of landmarks by cameras.

    Attributes:
        pose: Index of the pose that made each observation, int64, shape :math:`(M,)`.
        point: Index of the observed point, int64, shape :math:`(M,)`.
    """

    pose: Tensor
    point: Tensor


@dataclass(frozen=True)
class BundleResult:
    """Result of a bundle adjustment.

    Attributes:
        T_cw: World-to-camera poses, float64, shape :math:`(K, 4, 4)`; fixed poses are bit-identical to the input.
        points: Positions of the landmarks, world frame, metres, float64, shape :math:`(P, 3)`.
        chi2: Squared whitened error of each observation, float64, shape :math:`(M,)`; infinite behind the camera. An
            observation is an outlier if its error is greater than ``observations.chi2_threshold``.
        cost_before: Sum of the robust squared errors at the start.
        cost_after: Sum of the robust squared errors at the result.
        iterations: Number of steps tried.
    """

    T_cw: Tensor
    points: Tensor
    chi2: Tensor
    cost_before: float
    cost_after: float
    iterations: int
    _residuals: Callable[[], BundleResiduals]

    @property
    def residuals(self) -> BundleResiduals:
        """Residuals at the result."""
        return self._residuals()


@dataclass(frozen=True)
class BundleResiduals:
    """Reprojection residuals at given poses and points. Observations are the last dimension, sorted as in the problem.

    Attributes:
        in_camera: Observed point of each observation, camera frame, metres, shape :math:`(3, M)`.
        projected: The observed points as `perspective` projects them, shape :math:`(3, M)`.
        R_cw: World-to-camera rotation of each observation, shape :math:`(3, 3, M)`.
        whitened: Residuals divided by their standard deviations, shape :math:`(3, M)`.
        weights: Weights of the Huber kernel, shape :math:`(M,)`.
        problem: The problem that the residuals belong to.
    """

    in_camera: Tensor
    projected: Tensor
    R_cw: Tensor
    whitened: Tensor
    weights: Tensor
    problem: BundleProblem

    @cached_property
    def normal_equations(self) -> NormalEquations:
        """Normal equations of the linearised robust cost; computed once for all damping factors."""
        return self.problem.linearise(self, self.whitened[None])


def sort_by_point(
    observations: Observations, camera: PinholeCamera, fixed: Tensor, point_count: int
) -> tuple[NDArray[np.int64], SortedProblem]:
    """Order of observations that sorts them by point, and a problem in that order, as arguments of the kernels.

    Args:
        observations: Observations of the points by the poses.
        camera: Intrinsics.
        fixed: True for poses that stay unchanged, bool, shape :math:`(K,)`.
        point_count: Number of points.
    """
    point, target = to_array(observations.point), whiten(observations, camera)
    order = np.argsort(point, kind="stable")
    return order, (
        to_array(target.scale).take(order, axis=1),
        to_array(target.offset).take(order, axis=1),
        to_array(observations.chi2_threshold)[order],
        to_array(observations.pose)[order],
        np.searchsorted(point[order], np.arange(point_count + 1)),
        np.flatnonzero(~to_array(fixed)),
    )


def _bundle_adjust_compiled(
    T_cw: Tensor,
    points: Tensor,
    observations: Observations,
    camera: PinholeCamera,
    fixed: Tensor,
    iterations: int = 10,
    tolerance: float = 1e-6,
) -> BundleResult:
    if T_cw.dtype != torch.float64 or points.dtype != torch.float64:
        return NotImplemented
    order, problem = sort_by_point(observations, camera, fixed, len(points))
    *state, squared, cost_before, cost_after, steps = kernels.bundle_adjust(
        to_array(T_cw),
        to_array(points),
        *problem,
        iterations,
        tolerance,
        REGULARISATION,
        MIN_DEPTH,
        DAMPING_SCHEDULE,
    )
    chi2 = np.empty_like(squared)
    chi2[order] = squared
    T_cw, points = map(torch.from_numpy, state)

    def residuals() -> BundleResiduals:
        return BundleProblem(observations, camera, fixed, len(points)).residuals_at((T_cw, points))[1]

    return BundleResult(T_cw, points, torch.from_numpy(chi2), cost_before, cost_after, steps, residuals)


@torch.no_grad()
@compiled_by(_bundle_adjust_compiled)
def bundle_adjust(
    T_cw: Tensor,
    points: Tensor,
    observations: Observations,
    camera: PinholeCamera,
    fixed: Tensor,
    iterations: int = 10,
    tolerance: float = 1e-6,
) -> BundleResult:
    """Optimise poses and points jointly.

    Args:
        T_cw: World-to-camera poses, float64, shape :math:`(K, 4, 4)`.
        points: Positions of the landmarks, world frame, metres, float64, shape :math:`(P, 3)`.
        observations: Observations of the points by the poses.
        camera: Intrinsics.
        fixed: True for poses that stay unchanged, bool, shape :math:`(K,)`. Without a fixed pose the world frame can
            drift.
        iterations: Maximum number of Levenberg-Marquardt steps.
        tolerance: Relative change of the cost that ends the optimisation.

    Returns:
        Poses and points with the lowest robust cost found.
    """
    problem = BundleProblem(observations, camera, fixed, len(points))
    found = levenberg_marquardt((T_cw, points), problem.residuals_at, problem.step, iterations, tolerance)
    T_cw, points = found.state
    chi2 = problem.in_input_order(chi_square(found.system.in_camera.T, found.system.whitened.T))
    return BundleResult(T_cw, points, chi2, found.cost_before, found.cost_after, found.iterations, lambda: found.system)


@dataclass
class BundleProblem:
    """Least-squares problem of a bundle adjustment. Its observations are sorted by pose, those of fixed poses last.

    Attributes:
        observations: Observations of the points by the poses.
        camera: Intrinsics.
        fixed: True for poses that stay unchanged, bool, shape :math:`(K,)`.
        point_count: Number of points.
    """

    observations: Observations
    camera: PinholeCamera
    fixed: Tensor
    point_count: int

    def __post_init__(self) -> None:
        observations, self._free = self.observations, torch.nonzero(~self.fixed)[:, 0]
        row = torch.full((len(self.fixed),), len(self._free))
        row[self._free] = torch.arange(len(self._free))
        self._row, self._order = row[observations.pose].sort(stable=True)
        self._counts = torch.bincount(self._row, minlength=len(self._free))[: len(self._free)].tolist()
        self._pose, self._point = observations.pose[self._order], observations.point[self._order]
        target = whiten(observations, self.camera)
        self._target = WhitenedMeasurements(target.scale[:, self._order], target.offset[:, self._order])
        self._limit = observations.chi2_threshold[self._order]

    @property
    def order(self) -> Tensor:
        """Index of each sorted observation among the given ones, int64, shape :math:`(M,)`."""
        return self._order

    def in_input_order(self, values: Tensor) -> Tensor:
        """Reorder one value per sorted observation, shape :math:`(M,)`, to the order of the given observations."""
        return torch.empty_like(values).index_copy_(0, self._order, values)

    def residuals_at(self, state: State) -> tuple[float, BundleResiduals]:
        """Robust cost at poses :math:`(K, 4, 4)` and points :math:`(P, 3)`, and the residuals."""
        T_cw, points = state
        T = gather_columns(T_cw[:, :3].flatten(1).T, self._pose).unflatten(0, (3, 4))
        x, y, z = gather_columns(points.T.contiguous(), self._point)
        in_camera = T[:, 3].addcmul(T[:, 0], x).addcmul_(T[:, 1], y).addcmul_(T[:, 2], z)
        projected = perspective(in_camera)
        residuals = self._target.residuals(projected)
        costs, weights = huber((residuals * residuals).sum(dim=0), self._limit)
        return float(costs.sum()), BundleResiduals(in_camera, projected, T[:, :3], residuals, weights, self)

    def jacobians(self, residuals: BundleResiduals) -> tuple[Tensor, Tensor]:
        """Jacobians of the whitened residuals by pose, shape (6, 3, M), and by point, shape (3, 3, M)."""
        by_pose = perspective_jacobian(residuals.projected) * self._target.scale
        return by_pose, _inner(residuals.R_cw.transpose(0, 1), by_pose[:3].transpose(0, 1))

    def linearise(self, residuals: BundleResiduals, columns: Tensor) -> NormalEquations:
        """Normal equations of the robust cost at the given residuals, with several right-hand sides.

        Args:
            residuals: Residuals at the poses and points of the linearisation.
            columns: Residuals of each right-hand side, whitened, shape :math:`(C, 3, M)`.
        """
        root, free = residuals.weights.sqrt(), sum(self._counts)
        by_pose, by_point = (jacobian * root for jacobian in self.jacobians(residuals))
        weighted = columns * root
        V = _inner(by_point, torch.cat([by_point, weighted]))
        by_pose = by_pose[..., :free]
        # One matrix product for each pose, whose observations are adjacent: faster than a sum of outer products.
        of_each = torch.cat([by_pose, weighted[..., :free]]).split(self._counts, dim=-1)
        U = [rows[None, :6] @ rows.T for rows in (of_one.flatten(1) for of_one in of_each)]
        index = self._point.expand(V.shape[0] * V.shape[1], -1)
        return NormalEquations(
            U=torch.cat([V.new_zeros(0, 6, 6 + len(columns)), *U]),
            V=V.new_zeros(len(index), self.point_count).scatter_add_(1, index, V.flatten(0, 1)).unflatten(0, (3, -1)),
            W=_inner(by_point[..., :free], by_pose),
            pose=self._row[:free],
            point=self._point[:free],
        )

    def remaining(self, residuals: BundleResiduals, columns: Tensor, damping: float) -> Tensor:
        """Part of each column that no change of poses and points explains, to first order.

        Args:
            residuals: Residuals at the poses and points of the linearisation.
            columns: Whitened residuals, shape :math:`(C, 3, M)`.
            damping: Damping of the step that explains most of them.

        Returns:
            Shape :math:`(C, 3, M)`.
        """
        pose_steps, point_steps = solve_normal_equations(self.linearise(residuals, columns), damping)
        by_pose, by_point = self.jacobians(residuals)
        free = sum(self._counts)
        remaining = columns + torch.einsum("aim,mac->cim", by_point, point_steps[self._point])
        remaining[..., :free] += torch.einsum("aim,mac->cim", by_pose[..., :free], pose_steps[self._row[:free]])
        return remaining

    def step(self, state: State, residuals: BundleResiduals, damping: float) -> State:
        """State after a damped Gauss-Newton step from the given state and its residuals."""
        T_cw, points = state
        pose_step, point_step = (step[..., 0] for step in solve_normal_equations(residuals.normal_equations, damping))
        return T_cw.index_copy(0, self._free, se3_exp(pose_step) @ T_cw[self._free]), points + point_step


def _inner(a: Tensor, b: Tensor) -> Tensor:
    """Inner products over the three residuals of each observation, (A, 3, M) and (B, 3, M) to (A, B, M).

    Elementwise operations over all observations are faster than one small matrix product for each.
    """
    total = a[:, None, 0] * b[:, 0]
    return total.addcmul_(a[:, None, 1], b[:, 1]).addcmul_(a[:, None, 2], b[:, 2])
