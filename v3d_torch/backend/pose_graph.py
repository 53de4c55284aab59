"""Pose-graph optimisation: poses that fit measured relative poses best (paper, Sec. III-E).

Source: Grisetti et al., "A Tutorial on Graph-Based SLAM", IEEE Intelligent Transportation Systems Magazine 2010. PyPose
provides Lie groups and their Jacobians. The normal equations are sparse, with 6x6 blocks for poses joined by an edge,
and are solved by SciPy's SuperLU.

Convention: poses ``T_wc`` are perturbed on the right, ``T_wc @ exp(xi)``, with ``xi = [translation, rotation]`` in the
camera frame; the error of an edge is ``log(T_ij^-1 T_wi^-1 T_wj)``, in the same order.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import pypose as pp
import scipy.sparse
import scipy.sparse.linalg
import torch
from pypose.lietensor.operation import SE3_Adj, se3_Jl_inv
from torch import Tensor

from v3d_torch.optim.levenberg_marquardt import huber, levenberg_marquardt


@dataclass(frozen=True)
class PoseGraphResult:
    """Result of a pose-graph optimisation.

    Attributes:
        T_wc: Camera-to-world poses, float64, shape :math:`(N, 4, 4)`; fixed poses are bit-identical to the input.
        cost_before: Sum of (robust) squared errors at the initial poses.
        cost_after: Sum of (robust) squared errors at the optimised poses.
        iterations: Number of Levenberg-Marquardt steps tried.
        converged: True if the optimisation stopped because the cost no longer changed.
    """

    T_wc: Tensor
    cost_before: float
    cost_after: float
    iterations: int
    converged: bool


@dataclass(frozen=True)
class _Edges:
    """Measured relative poses, with the indices i and j of the poses that each of them joins."""

    i: Tensor
    j: Tensor
    T_ji: pp.LieTensor
    information: Tensor


_NormalEquations = tuple[scipy.sparse.csc_array, Tensor]
"""J^T W J and J^T W r over the free poses, six unknowns each."""

_REGULARISATION = 1e-9
"""Added to the diagonal of the normal equations, so that they have a solution for poses without any edge; negligible
beside the information of an edge."""


@torch.no_grad()
def optimise_pose_graph(
    T_wc: Tensor,
    edges: Tensor,
    T_ij: Tensor,
    information: Tensor | None = None,
    fixed: Tensor | None = None,
    *,
    iterations: int = 50,
    robust: float | None = None,
) -> PoseGraphResult:
    r"""Minimise :math:`\sum_{ij} \rho(e_{ij}^T \Omega_{ij} e_{ij})` over the free poses.

    Args:
        T_wc: Initial camera-to-world poses, float64, shape :math:`(N, 4, 4)`.
        edges: Indices (i, j) of the poses joined by each measurement, i and j different, int64, shape :math:`(E, 2)`.
        T_ij: Measured pose of camera j in camera i, ``T_wi^-1 T_wj``, float64, shape :math:`(E, 4, 4)`.
        information: Inverse covariances of the errors, float64, shape :math:`(E, 6, 6)`; the identity by default.
        fixed: Mask of the poses that are not optimised, bool, shape :math:`(N,)`; only the first by default.
        iterations: Maximum number of Levenberg-Marquardt steps.
        robust: Error, in standard deviations, above which Huber's kernel grows linearly; None for plain least squares.

    Returns:
        The poses of minimal cost. Poses that no path of edges joins to a fixed pose are determined only relative to
        each other.
    """
    if fixed is None:
        fixed = torch.arange(T_wc.shape[0]) == 0
    if information is None:
        information = torch.eye(6, dtype=torch.float64).expand(edges.shape[0], 6, 6)
    graph = _Edges(edges[:, 0], edges[:, 1], pp.mat2SE3(T_ij, check=False).Inv(), information)
    free = torch.nonzero(~fixed)[:, 0]
    found = levenberg_marquardt(
        pp.mat2SE3(T_wc, check=False),
        partial(_linearise, graph=graph, free=free, limit=torch.inf if robust is None else robust**2),
        partial(_step, free=free),
        iterations,
    )
    optimised = T_wc.index_copy(0, free, found.state.matrix()[free])
    return PoseGraphResult(optimised, found.cost_before, found.cost_after, found.iterations, found.converged)


def edge_errors(T_wi: pp.LieTensor, T_wj: pp.LieTensor, T_ji: pp.LieTensor) -> tuple[Tensor, Tensor, Tensor]:
    """Errors of edges and their Jacobians with respect to right perturbations of both poses.

    Args:
        T_wi: Poses at the start of each edge, SE3, shape :math:`(E,)`.
        T_wj: Poses at the end of each edge, SE3, shape :math:`(E,)`.
        T_ji: Inverse of the measured relative pose of each edge, SE3, shape :math:`(E,)`.

    Returns:
        Errors, shape :math:`(E, 6)`, and their Jacobians with respect to pose i and pose j, each of shape
        :math:`(E, 6, 6)`.
    """
    predicted_T_ij = T_wi.Inv() @ T_wj
    error = (T_ji @ predicted_T_ij).Log().tensor()
    J_j = se3_Jl_inv(-error)  # log(E exp(xi)) = log(E) + Jr^-1(log(E)) xi, and Jr(e) = Jl(-e)
    J_i = -J_j @ SE3_Adj(predicted_T_ij.Inv().tensor())  # exp(-xi) T = T exp(-Ad(T^-1) xi)
    return error, J_i, J_j


def _linearise(T_wc: pp.LieTensor, graph: _Edges, free: Tensor, limit: float) -> tuple[float, _NormalEquations]:
    """Cost and normal equations at given poses; ``limit`` is the squared error from which Huber's kernel is linear."""
    error, J_i, J_j = edge_errors(T_wc[graph.i], T_wc[graph.j], graph.T_ji)
    squared = torch.einsum("ea,eab,eb->e", error, graph.information, error)
    costs, weights = huber(squared, limit)

    J = torch.cat([J_i, J_j], dim=2)  # E x 6 x 12
    weighted = J.mT @ (weights[:, None, None] * graph.information)
    free_index = torch.full((T_wc.shape[0],), -1)
    free_index[free] = torch.arange(free.shape[0])
    # Index of the unknown of each of the 12 columns of an edge; negative if the pose is fixed.
    unknown = (6 * free_index[torch.stack([graph.i, graph.j], dim=1)][..., None] + torch.arange(6)).flatten(1)
    size = 6 * free.shape[0]

    gradient = torch.zeros(size, dtype=error.dtype)
    is_free = unknown >= 0
    gradient.index_add_(0, unknown[is_free], (weighted @ error[..., None])[..., 0][is_free])
    rows, columns = unknown[:, :, None].expand(-1, 12, 12), unknown[:, None, :].expand(-1, 12, 12)
    is_free = (rows >= 0) & (columns >= 0)
    entries = (weighted @ J)[is_free].numpy(), (rows[is_free].numpy(), columns[is_free].numpy())
    return float(costs.sum()), (scipy.sparse.coo_array(entries, shape=(size, size)).tocsc(), gradient)


def _step(T_wc: pp.LieTensor, system: _NormalEquations, damping: float, free: Tensor) -> pp.LieTensor:
    """Poses after one damped step."""
    H, gradient = system
    damped = H + scipy.sparse.diags_array(damping * H.diagonal() + _REGULARISATION)
    # The matrix is symmetric and positive definite: use a symmetric ordering and no pivoting.
    factors = scipy.sparse.linalg.splu(
        damped.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
    xi = torch.from_numpy(factors.solve(-gradient.numpy())).reshape(-1, 6)
    moved = T_wc.tensor().clone()
    moved[free] = (T_wc[free] @ pp.se3(xi).Exp()).tensor()
    return pp.SE3(moved)
