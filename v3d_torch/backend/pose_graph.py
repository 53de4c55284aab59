"""Pose-graph optimisation: least squares of poses over measured relative poses (paper, Sec. III-E).

Source: Grisetti et al., "A Tutorial on Graph-Based SLAM", IEEE Intelligent Transportation Systems Magazine 2010. The
normal equations are sparse, with 6x6 blocks for poses joined by an edge.

Convention: poses ``T_wc`` are perturbed on the right, ``T_wc @ exp(xi)``, with ``xi = [translation, rotation]`` in the
camera frame; the error of an edge is ``log(T_ij^-1 T_wi^-1 T_wj)``, in the same order.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypeGuard

import torch
from torch import Tensor

from v3d_torch.errors import InputError
from v3d_torch.geometry.argument_checks import check_counts, check_masks, check_positive
from v3d_torch.geometry.gradients import needs_gradient, without_second_derivatives, zero_with_gradient
from v3d_torch.geometry.precision import result_dtype, working_dtype
from v3d_torch.geometry.se3 import adjoint, invert, left_jacobian_inverse, se3_exp, se3_log
from v3d_torch.geometry.settings_module import SettingsModule
from v3d_torch.kernels import pose_graph as kernels
from v3d_torch.kernels.compiler import can_read, compiled_by
from v3d_torch.optim.block_system import solve_block_system
from v3d_torch.optim.implicit import jacobian
from v3d_torch.optim.levenberg_marquardt import DAMPING_SCHEDULE, REGULARISATION, levenberg_marquardt
from v3d_torch.optim.robust_losses import huber
from v3d_torch.runtime.batches import (
    check_finite_arguments,
    check_shapes,
    fill_fixed,
    fill_indices,
    fill_weights,
    from_rows,
    mask_or_all,
    to_rows,
)

if TYPE_CHECKING:
    import pypose as pp


class PoseGraphResult(NamedTuple):
    """Result of a pose-graph optimisation.

    Attributes:
        T_wc: Camera-to-world poses, shape :math:`(*, N, 4, 4)`, or PyPose's SE3, shape :math:`(*, N)`, if the initial
            poses had that type; fixed poses are bit-identical to the input.
        cost_before: Sum of the weighted (robust) squared errors at the initial poses, shape :math:`(*)`.
        cost_after: Sum of the weighted (robust) squared errors at the optimised poses, shape :math:`(*)`.
        iterations: Number of Levenberg-Marquardt steps tried, int64, shape :math:`(*)`.
        converged: True if the optimisation converged within the number of iterations, bool, shape :math:`(*)`.
    """

    T_wc: Tensor
    cost_before: Tensor
    cost_after: Tensor
    iterations: Tensor
    converged: Tensor


def optimise_pose_graph(
    T_wc: Tensor,
    edges: Tensor,
    T_ij: Tensor,
    information: Tensor | None = None,
    fixed: Tensor | None = None,
    weights: Tensor | None = None,
    valid: Tensor | None = None,
    *,
    iterations: int = 50,
    tolerance: float = 1e-6,
    robust: float | None = None,
) -> PoseGraphResult:
    r"""Minimise the errors of a pose graph over the free poses.

    .. math::
        \min_{\{T_{wi}\}} \sum_{(i, j)} w_{ij}\, \rho( e_{ij}^\top \Omega_{ij} e_{ij} ), \qquad
        e_{ij} = \log\left( T_{ij}^{-1}\, T_{wi}^{-1}\, T_{wj} \right)

    The result is differentiable in the measured poses, information, weights and fixed poses, by the implicit function
    theorem: memory does not grow with the iterations, but with the square of N. The Hessian is that of the robust cost,
    including the dependence of the robust weights on the errors. The derivatives are as accurate as the optimum: train
    with a small ``tolerance`` and enough ``iterations``. There are no second derivatives: autograd raises an
    InputError, and those of `torch.func` are not correct.

    Grisetti et al., A Tutorial on Graph-Based SLAM, 2010; Gould et al., On Differentiating Parameterized Argmin and
    Argmax Problems, 2016.

    Args:
        T_wc: Initial camera-to-world poses, shape :math:`(*, N, 4, 4)`, or PyPose's SE3 of shape :math:`(*, N)`. All
            inputs are floating point except edges and masks, and converted to float64.
        edges: Indices (i, j) of the poses joined by each measurement, from 0 to N - 1, i and j different, int64, shape
            :math:`(*, E, 2)`; any indices for padding.
        T_ij: Measured pose of camera j in camera i, ``T_wi^-1 T_wj``, shape :math:`(*, E, 4, 4)`, or PyPose's SE3 of
            shape :math:`(*, E)`.
        information: Inverse covariances of the errors, shape :math:`(*, E, 6, 6)`, of which the symmetric part is used;
            None for the identity.
        fixed: Mask of the poses that stay unchanged, bool, shape :math:`(*, N)`; None for only the first. Poses that
            are padding have no edges; they must be finite, and are returned unchanged.
        weights: Weight of each edge, not negative, shape :math:`(*, E)`; None for 1.
        valid: Mask of the edges that are not padding, bool, shape :math:`(*, E)`; None for all.
        iterations: Maximum number of Levenberg-Marquardt steps.
        tolerance: Relative change of the cost that ends the optimisation.
        robust: Error, in standard deviations, above which Huber's loss grows linearly; None for plain least squares.

    Returns:
        The poses of minimal cost, with the dtype of ``T_wc``, float32 for integers; costs at least in float32.
        Poses without a path of edges to a fixed pose are determined only relative to each other.

    Raises:
        InputError: If ``edges`` is not int64, has an index out of range or joins a pose to itself, if a mask is not
            bool, if a pose or an information matrix is not finite, if an information matrix has a negative value on its
            diagonal, or if a weight is negative, infinite or NaN.
        ConfigError: If ``robust`` is not positive, or ``iterations`` is negative or not a whole number.
    """
    check_masks(fixed=fixed, valid=valid)
    _check_settings(iterations, robust)
    initial, measured = (T.matrix() if _is_lie_tensor(T) else T for T in (T_wc, T_ij))
    batch = check_shapes(
        T_wc=(initial, "N", 4, 4),
        T_ij=(measured, "E", 4, 4),
        edges=(edges, "E", 2),
        information=(information, "E", 6, 6),
        fixed=(fixed, "N"),
        weights=(weights, "E"),
        valid=(valid, "E"),
    )
    graph, start = _prepare(batch, initial, edges, measured, information, fixed, weights, valid, robust)
    with torch.no_grad():
        found = _minimise(start.detach(), *graph.detach(), iterations=iterations, tolerance=tolerance)
    cost_after, steps = found.cost_after, None
    if needs_gradient(start, *graph):
        steps = graph.differentiate(found.T_wc, start)
        cost_after, _ = graph.linearise(torch.where(graph.is_fixed, start, found.T_wc @ se3_exp(steps)))
    return found._replace(
        T_wc=_move(T_wc, found.T_wc, steps, graph.is_fixed),
        cost_before=found.cost_before.to(working_dtype(T_wc.dtype)),
        cost_after=cost_after.to(working_dtype(T_wc.dtype)),
    )


def edge_errors(T_wi: Tensor, T_wj: Tensor, T_ji: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Errors of edges and their Jacobians with respect to right perturbations of both poses.

    Args:
        T_wi: Poses at the start of each edge, shape :math:`(..., E, 4, 4)`.
        T_wj: Poses at the end of each edge, shape :math:`(..., E, 4, 4)`.
        T_ji: Inverse of the measured relative pose of each edge, shape :math:`(..., E, 4, 4)`.

    Returns:
        Errors, shape :math:`(..., E, 6)`, and their Jacobians with respect to pose i and pose j, each of shape
        :math:`(..., E, 6, 6)`.
    """
    predicted_T_ij = invert(T_wi) @ T_wj
    error = se3_log(T_ji @ predicted_T_ij)
    J_j = left_jacobian_inverse(-error)  # log(E exp(xi)) = log(E) + Jr^-1(log(E)) xi, and Jr(e) = Jl(-e)
    J_i = -J_j @ adjoint(invert(predicted_T_ij))  # exp(-xi) T = T exp(-Ad(T^-1) xi)
    return error, J_i, J_j


def _check_settings(iterations: int, robust: float | None) -> None:
    check_counts(iterations=iterations)
    if robust is not None:
        check_positive(robust=robust)


class _Graph(NamedTuple):
    """Edges of a pose graph: measured relative poses, with the indices of both poses."""

    edges: Tensor  # (..., E, 2)
    T_ji: Tensor  # (..., E, 4, 4)
    information: Tensor  # (..., E, 6, 6)
    weights: Tensor  # (..., E)
    fixed: Tensor  # (..., N)
    limit: Tensor  # (), squared error from which Huber's loss is linear

    @property
    def is_fixed(self) -> Tensor:
        return self.fixed[..., None, None]

    def detach(self) -> _Graph:
        return _Graph(*(column.detach() for column in self))

    def linearise(self, T_wc: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """Cost at given poses, and the blocks (..., E, 12, 12) and gradients (..., E, 12) of the edges."""
        error, J, weights, costs = self._evaluate(self._ends(T_wc))
        weighted = J.mT @ (weights[..., None, None] * self.information)
        return (costs * self.weights).sum(dim=-1), (weighted @ J, (weighted @ error[..., None])[..., 0])

    def step(self, T_wc: Tensor, system: tuple[Tensor, Tensor], damping: Tensor | float) -> Tensor:
        """Poses after one damped step."""
        xi = solve_block_system(*system, self.edges, self.fixed, damping, REGULARISATION)
        return torch.where(self.is_fixed, T_wc, T_wc @ se3_exp(xi))

    def differentiate(self, T_wc: Tensor, initial: Tensor) -> Tensor:
        """Return zero steps at the optimum, with derivatives.

        They are those with respect to the measurements and to the fixed poses of ``initial``.
        """
        constant = self.detach()
        ends = constant._ends(T_wc)
        blocks = jacobian(lambda xi: constant._gradient(ends, xi), T_wc.new_zeros(*self.edges.shape[:-1], 12))
        anchored = torch.where(self.is_fixed, without_second_derivatives(initial), T_wc)
        graph = _Graph(*map(without_second_derivatives, self))
        gradient = graph._gradient(graph._ends(anchored), None)
        steps = solve_block_system(blocks, gradient, self.edges, self.fixed, 0.0, REGULARISATION)
        return zero_with_gradient(steps)

    def _ends(self, T_wc: Tensor) -> tuple[Tensor, Tensor]:
        """Poses at both ends of each edge, (..., E, 4, 4)."""
        i, j = (torch.take_along_dim(T_wc, end[..., None, None], dim=-3) for end in self.edges.unbind(-1))
        return i, j

    def _evaluate(self, ends: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Errors (..., E, 6), Jacobians (..., E, 6, 12), weights in the normal equations and robust costs (..., E)."""
        error, J_i, J_j = edge_errors(*ends, self.T_ji)
        squared = ((error[..., None, :] @ self.information)[..., 0, :] * error).sum(dim=-1)
        costs, weights = huber(squared, self.limit)
        return error, torch.cat([J_i, J_j], dim=-1), weights * self.weights, costs

    def _gradient(self, ends: tuple[Tensor, Tensor], xi: Tensor | None) -> Tensor:
        """Half the gradient of the cost of each edge by its unknowns, (..., E, 12), after the update ``xi``."""
        if xi is not None:
            ends = ends[0] @ se3_exp(xi[..., :6]), ends[1] @ se3_exp(xi[..., 6:])
        error, J, weights, _ = self._evaluate(ends)
        return (J.mT @ (weights[..., None, None] * self.information) @ error[..., None])[..., 0]


def _minimise_compiled(T_wc: Tensor, *graph: Tensor, iterations: int, tolerance: float) -> PoseGraphResult:
    batch, (*columns, limit) = T_wc.shape[:-3], graph
    if 0 in batch:
        return NotImplemented
    settings = float(limit), iterations, tolerance, REGULARISATION, DAMPING_SCHEDULE
    rows = zip(*(to_rows(each, batch) for each in (T_wc, *columns)), strict=True)
    problems = [(*row, *settings) for row in rows]
    return PoseGraphResult(*from_rows([kernels.optimise_pose_graph(*problem) for problem in problems], batch))


@compiled_by(_minimise_compiled)
def _minimise(T_wc: Tensor, *graph: Tensor, iterations: int, tolerance: float) -> PoseGraphResult:
    """Optimise poses by Levenberg-Marquardt; the tensors are those of `_Graph`."""
    at = _Graph(*graph)
    found = levenberg_marquardt(T_wc, at.linearise, at.step, iterations, tolerance)
    return PoseGraphResult(found.state, found.cost_before, found.cost_after, found.iterations, found.converged)


def _prepare(
    batch: torch.Size,
    T_wc: Tensor,
    edges: Tensor,
    T_ij: Tensor,
    information: Tensor | None,
    fixed: Tensor | None,
    weights: Tensor | None,
    valid: Tensor | None,
    robust: float | None,
) -> tuple[_Graph, Tensor]:
    """Graph and initial poses in float64, with the batch dimensions of all inputs."""
    count, device = edges.shape[-2], T_wc.device
    identity = torch.eye(6, dtype=torch.float64, device=device)
    fixed = fill_fixed(fixed, T_wc)
    if information is None:
        information = identity.expand(count, 6, 6)
    weights = fill_weights(weights, mask_or_all(valid, edges[..., 0]))
    T_ij, information = T_ij.to(torch.float64), information.to(torch.float64)
    edges = fill_indices("edges", edges, T_wc.shape[-3], None if valid is None else valid[..., None])
    if can_read(edges):
        i, j = edges.unbind(dim=-1)
        joins_itself = (i == j) & mask_or_all(valid, i)
        if bool(joins_itself.any()):
            pose = int(i.expand(joins_itself.shape)[joins_itself][0])
            raise InputError(f"edges joins pose {pose} to itself; give edges between two different poses")
    if valid is not None:
        T_ij = torch.where(valid[..., None, None], T_ij, identity[:4, :4])
        information = torch.where(valid[..., None, None], information, identity)
    check_finite_arguments(T_wc=T_wc, T_ij=T_ij, information=information)
    if can_read(information) and bool((information.diagonal(dim1=-2, dim2=-1) < 0).any()):
        raise InputError("information has a negative value on a diagonal; give inverse covariances")
    information = (information + information.mT) / 2  # a skew part has no influence on the cost, but on its gradient
    graph = _Graph(
        edges=edges.expand(*batch, count, 2),
        T_ji=invert(T_ij).expand(*batch, count, 4, 4),
        information=information.expand(*batch, count, 6, 6),
        weights=weights.expand(*batch, count),
        fixed=fixed.expand(*batch, T_wc.shape[-3]),
        limit=torch.tensor(torch.inf if robust is None else robust**2, dtype=torch.float64, device=device),
    )
    return graph, T_wc.to(torch.float64).expand(*batch, *T_wc.shape[-3:])


def _is_lie_tensor(T: Tensor) -> TypeGuard[pp.LieTensor]:
    """Check for a tensor of PyPose without importing PyPose."""
    return hasattr(T, "ltype")


def _move(initial: Tensor, optimum: Tensor, steps: Tensor | None, is_fixed: Tensor) -> Tensor:
    """Return the optimum with its derivatives, in the type of the initial poses; fixed poses are kept."""
    if _is_lie_tensor(initial):
        import pypose as pp  # the import takes long, and few callers need it

        T = pp.mat2SE3(optimum, check=False)
        T = T if steps is None else T @ pp.se3(steps).Exp()
        return pp.SE3(torch.where(is_fixed[..., 0], initial.tensor(), T.tensor().to(initial.dtype)))
    T = optimum if steps is None else optimum @ se3_exp(steps)
    dtype = result_dtype(initial.dtype)
    return torch.where(is_fixed, initial.to(dtype), T.to(dtype))


class PoseGraphOptimiser(SettingsModule):
    """:func:`optimise_pose_graph` as a module.

    Args:
        iterations: Maximum number of Levenberg-Marquardt steps.
        tolerance: Relative change of the cost that ends the optimisation.
        robust: Error, in standard deviations, above which Huber's loss grows linearly; None for plain least squares.

    Raises:
        ConfigError: If a number is not possible; see :func:`optimise_pose_graph`.
    """

    def __init__(self, iterations: int = 50, tolerance: float = 1e-6, robust: float | None = None) -> None:
        _check_settings(iterations, robust)
        super().__init__()
        self.iterations = iterations
        self.tolerance = tolerance
        self.robust = robust

    def forward(
        self,
        T_wc: Tensor,
        edges: Tensor,
        T_ij: Tensor,
        information: Tensor | None = None,
        fixed: Tensor | None = None,
        weights: Tensor | None = None,
        valid: Tensor | None = None,
    ) -> PoseGraphResult:
        """Optimise poses :math:`(*, N, 4, 4)` by E edges; see :func:`optimise_pose_graph`."""
        return optimise_pose_graph(
            T_wc,
            edges,
            T_ij,
            information=information,
            fixed=fixed,
            weights=weights,
            valid=valid,
            iterations=self.iterations,
            tolerance=self.tolerance,
            robust=self.robust,
        )
