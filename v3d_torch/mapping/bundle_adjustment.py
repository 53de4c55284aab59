"""Bundle adjustment: keyframe poses and landmarks that explain all observations best (ORB-SLAM2, local mapping).

Levenberg-Marquardt on robust errors in pixels and inverse depth; landmarks are eliminated by the Schur complement
(Triggs et al., "Bundle Adjustment - A Modern Synthesis", 2000); what is left, 6 unknowns per pose, is solved densely.

Convention: poses ``T_cw`` are perturbed on the left, ``exp(xi) @ T_cw``, with ``xi = [translation, rotation]``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.optim.levenberg_marquardt import huber, levenberg_marquardt
from v3d_torch.optim.reprojection import (
    Measurements,
    WhitenedMeasurements,
    chi_square,
    perspective,
    perspective_jacobian,
    whiten,
)
from v3d_torch.optim.schur import NormalEquations, gather_columns, solve_normal_equations


@dataclass(frozen=True, kw_only=True)
class Observations(Measurements):
    """Measurements, and who sees whom in them.

    Attributes:
        pose: index of the camera, int64, shape :math:`(M,)`.
        point: index of the landmark, int64, shape :math:`(M,)`.
    """

    pose: Tensor
    point: Tensor


@dataclass(frozen=True)
class BundleResult:
    """An adjusted map.

    Attributes:
        T_cw: world to camera, float64, shape :math:`(K, 4, 4)`; fixed poses are as given, to the bit.
        points: world frame, metres, float64, shape :math:`(P, 3)`.
        chi2: squared error of each observation in sigmas, float64, shape :math:`(M,)`; infinite behind the camera.
            Compare with ``observations.limit`` to find outliers.
        cost_before: sum of robust squared errors at the start.
        cost_after: the same at the end.
        iterations: steps tried.
        errors: at the end.
    """

    T_cw: Tensor
    points: Tensor
    chi2: Tensor
    cost_before: float
    cost_after: float
    iterations: int
    errors: Errors


@dataclass(frozen=True)
class Errors:
    """The errors at some poses and points. In all that follows the observations come last, sorted as in `Bundle`.

    Attributes:
        in_camera: point of each observation in its camera, metres, shape :math:`(3, M)`.
        seen: where, as `perspective` gives it, shape :math:`(3, M)`.
        R: rotations from the world into its camera, shape :math:`(3, 3, M)`.
        residuals: in sigmas, shape :math:`(3, M)`.
        weights: of Huber's kernel, shape :math:`(M,)`.
        bundle: they are of.
    """

    in_camera: Tensor
    seen: Tensor
    R: Tensor
    residuals: Tensor
    weights: Tensor
    bundle: Bundle

    @cached_property
    def normal_equations(self) -> NormalEquations:
        """The robust cost linearised, once for however many steps are tried from there."""
        return self.bundle.linearise(self)

    def profile(self, drift: Tensor) -> tuple[float, float]:
        r"""How the cost would go on if all was seen elsewhere, and adjusted anew: as far as it is a parabola.

        With the errors' change :math:`j` by that and their Jacobian :math:`J` by poses and points, these follow by
        :math:`-(J^T W J)^{-1} J^T W j`, and what is left of :math:`j` changes the cost.

        Args:
            drift: of the places where it was seen, pixels for one of whatever unit, float64, shape :math:`(M, 2)`.

        Returns:
            First and second derivative of the cost by that unit.
        """
        j = self.bundle.drifted(drift)
        here, change = self.normal_equations, replace(self, residuals=j).normal_equations
        xi, moved = solve_normal_equations(change, _NEXT_TO_NONE)
        first, second = (
            float((self.weights * j * of).sum() + (xi * by.U[..., 6]).sum() + (moved.T * by.V[:, 3]).sum())
            for of, by in ((self.residuals, here), (j, change))
        )
        return 2 * first, 2 * second


_NEXT_TO_NONE = 1e-9
"""Damping of a step that is to be taken whole."""

State = tuple[Tensor, Tensor]  # T_cw (K, 4, 4), points (P, 3)


@torch.no_grad()
def bundle_adjust(
    T_cw: Tensor,
    points: Tensor,
    observations: Observations,
    camera: PinholeCamera,
    fixed: Tensor,
    iterations: int = 10,
    tolerance: float = 1e-6,
) -> BundleResult:
    """Adjust poses and points together.

    Args:
        T_cw: world-to-camera poses, float64, shape :math:`(K, 4, 4)`.
        points: landmarks, world frame, metres, float64, shape :math:`(P, 3)`.
        observations: of the points by the poses.
        camera: intrinsics.
        fixed: poses that stay as they are, bool, shape :math:`(K,)`. Without one the map as a whole may drift.
        iterations: most Levenberg-Marquardt steps.
        tolerance: relative change of the cost that ends them.

    Returns:
        Poses and points at the least robust cost found.
    """
    bundle = Bundle(observations, camera, fixed, len(points))
    found = levenberg_marquardt((T_cw, points), bundle.errors_at, bundle.step, iterations, tolerance)
    T_cw, points = found.state
    chi2 = bundle.as_given(chi_square(found.system.in_camera.T, found.system.residuals.T))
    return BundleResult(T_cw, points, chi2, found.cost_before, found.cost_after, found.iterations, found.system)


class Bundle:
    """The least-squares problem. Its observations are sorted: those of free poses first, pose by pose.

    Args:
        observations: of the points by the poses.
        camera: intrinsics.
        fixed: poses that stay as they are, bool, shape :math:`(K,)`.
        points: how many there are.
    """

    def __init__(self, observations: Observations, camera: PinholeCamera, fixed: Tensor, points: int) -> None:
        self._points = points
        self._free = torch.nonzero(~fixed)[:, 0]
        row = torch.full((len(fixed),), len(self._free))
        row[self._free] = torch.arange(len(self._free))
        self._row, self._order = row[observations.pose].sort(stable=True)
        self._counts = torch.bincount(self._row, minlength=len(self._free))[: len(self._free)].tolist()
        self._pose, self._point = observations.pose[self._order], observations.point[self._order]
        target = whiten(observations, camera)
        self._target = WhitenedMeasurements(target.scale[:, self._order], target.offset[:, self._order])
        self._limit, self._sigma = observations.chi2_threshold[self._order], observations.pixel_sigma[self._order]

    def as_given(self, of_each: Tensor) -> Tensor:
        """Numbers of the sorted observations, (M,), in the order in which these were given."""
        return torch.empty_like(of_each).index_copy_(0, self._order, of_each)

    def drifted(self, drift: Tensor) -> Tensor:
        """How the errors change when what is seen moves by drift, pixels as given, (M, 2); shape :math:`(3, M)`."""
        change = torch.zeros_like(self._target.scale)
        change[:2] = -drift[self._order].T / self._sigma
        return change

    def errors_at(self, state: State) -> tuple[float, Errors]:
        """The robust cost at poses :math:`(K, 4, 4)` and points :math:`(P, 3)`, and what it is the sum of."""
        T_cw, points = state
        T = gather_columns(T_cw[:, :3].flatten(1).T, self._pose).unflatten(0, (3, 4))
        x, y, z = gather_columns(points.T.contiguous(), self._point)
        in_camera = T[:, 3].addcmul(T[:, 0], x).addcmul_(T[:, 1], y).addcmul_(T[:, 2], z)
        seen = perspective(in_camera)
        residuals = self._target.residuals(seen)
        costs, weights = huber((residuals * residuals).sum(dim=0), self._limit)
        return float(costs.sum()), Errors(in_camera, seen, T[:, :3], residuals, weights, self)

    def linearise(self, errors: Errors) -> NormalEquations:
        """The robust cost linearised at some errors."""
        root, free = errors.weights.sqrt(), sum(self._counts)
        by_pose = perspective_jacobian(errors.seen) * (self._target.scale * root)
        by_point = _inner(errors.R.transpose(0, 1), by_pose[:3].transpose(0, 1))
        residuals = (errors.residuals * root)[None]
        V = _inner(by_point, torch.cat([by_point, residuals]))
        by_pose = by_pose[..., :free]
        # Pose by pose, as the errors of one lie side by side: adding up outer products of single errors takes long.
        of_each = torch.cat([by_pose, residuals[..., :free]]).split(self._counts, dim=-1)
        U = [rows[None, :6] @ rows.T for rows in (of_one.flatten(1) for of_one in of_each)]
        index = self._point.expand(12, -1)
        return NormalEquations(
            U=torch.cat([V.new_zeros(0, 6, 7), *U]),
            V=V.new_zeros(12, self._points).scatter_add_(1, index, V.flatten(0, 1)).unflatten(0, (3, 4)),
            W=_inner(by_point[..., :free], by_pose),
            pose=self._row[:free],
            point=self._point[:free],
        )

    def step(self, state: State, errors: Errors, damping: float) -> State:
        """The state after a damped Gauss-Newton step from errors there."""
        T_cw, points = state
        xi, moved = solve_normal_equations(errors.normal_equations, damping)
        return T_cw.index_copy(0, self._free, se3_exp(xi) @ T_cw[self._free]), points + moved


def _inner(a: Tensor, b: Tensor) -> Tensor:
    """Sums over the errors of products of derivatives, (A, 3, M) and (B, 3, M) to (A, B, M).

    Error by error: as matrix products of three by three, one for each observation, it takes three times as long.
    """
    total = a[:, None, 0] * b[:, 0]
    return total.addcmul_(a[:, None, 1], b[:, 1]).addcmul_(a[:, None, 2], b[:, 2])
