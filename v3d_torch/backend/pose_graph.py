"""Pose-graph optimisation: poses that agree best with measured relative motions (paper, Sec. III-E).

Grisetti et al., "A Tutorial on Graph-Based SLAM", IEEE Intelligent Transportation Systems Magazine 2010. Lie groups and
their Jacobians are PyPose's; the normal equations are sparse, 6x6 blocks where an edge joins two poses, factorised by
SciPy's SuperLU.

Convention: poses ``T_wc`` are perturbed on the right, ``T_wc @ exp(xi)``, with ``xi = [translation, rotation]`` in the
camera's frame; the error of an edge is ``log(T_ij^-1 T_wi^-1 T_wj)``, in the same order.
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
    """An optimised pose graph.

    Attributes:
        T_wc: camera to world, float64, shape :math:`(N, 4, 4)`; fixed poses are as given, to the bit.
        cost_before: sum of (robust) squared errors at the start.
        cost_after: the same at the end.
        iterations: steps tried.
        converged: whether it ended because the cost no longer changed.
    """

    T_wc: Tensor
    cost_before: float
    cost_after: float
    iterations: int
    converged: bool


@dataclass(frozen=True)
class _Edges:
    """Measured motions from pose i to pose j."""

    i: Tensor
    j: Tensor
    T_ji: pp.LieTensor
    information: Tensor


_System = tuple[scipy.sparse.csc_array, Tensor]  # J^T W J and J^T W r over the free poses


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
        T_wc: camera-to-world poses, float64, shape :math:`(N, 4, 4)`.
        edges: poses (i, j) joined by each measurement, int64, shape :math:`(E, 2)`, i and j different.
        T_ij: measured pose of camera j in camera i, ``T_wi^-1 T_wj``, float64, shape :math:`(E, 4, 4)`.
        information: inverse covariances of the errors, shape :math:`(E, 6, 6)`; the identity by default.
        fixed: poses that stay as they are, bool, shape :math:`(N,)`; the first by default.
        iterations: most Levenberg-Marquardt steps.
        robust: error, in standard deviations, above which Huber's kernel grows linearly; None for plain squares.

    Returns:
        The poses of least cost; those that no edge joins to a fixed one agree with their neighbours only.
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
    """Errors of edges and their Jacobians by the right perturbations of both poses.

    Args:
        T_wi: poses at the start of each edge, SE3, shape :math:`(E,)`.
        T_wj: poses at its end.
        T_ji: measured motion, inverted.

    Returns:
        errors, shape :math:`(E, 6)`, Jacobians by i and by j, shape :math:`(E, 6, 6)`.
    """
    motion = T_wi.Inv() @ T_wj
    error = (T_ji @ motion).Log().tensor()
    by_j = se3_Jl_inv(-error)  # log(E exp(xi)) = log(E) + Jr^-1(log(E)) xi, and Jr(e) = Jl(-e)
    by_i = -by_j @ SE3_Adj(motion.Inv().tensor())  # exp(-xi) motion = motion exp(-Ad(motion^-1) xi)
    return error, by_i, by_j


def _linearise(T_wc: pp.LieTensor, graph: _Edges, free: Tensor, limit: float) -> tuple[float, _System]:
    error, by_i, by_j = edge_errors(T_wc[graph.i], T_wc[graph.j], graph.T_ji)
    squared = torch.einsum("ea,eab,eb->e", error, graph.information, error)
    costs, weights = huber(squared, limit)

    J = torch.cat([by_i, by_j], dim=2)  # (E, 6, 12)
    weighted = J.mT @ (weights[:, None, None] * graph.information)
    column = torch.full((T_wc.shape[0],), -1)
    column[free] = torch.arange(free.shape[0])
    # Number of the unknown behind each of an edge's 12 columns; negative where the pose is fixed.
    unknown = (6 * column[torch.stack([graph.i, graph.j], dim=1)][..., None] + torch.arange(6)).flatten(1)
    size = 6 * free.shape[0]

    gradient = torch.zeros(size, dtype=error.dtype)
    known = unknown >= 0
    gradient.index_add_(0, unknown[known], (weighted @ error[..., None])[..., 0][known])
    rows, columns = unknown[:, :, None].expand(-1, 12, 12), unknown[:, None, :].expand(-1, 12, 12)
    known = (rows >= 0) & (columns >= 0)
    entries = (weighted @ J)[known].numpy(), (rows[known].numpy(), columns[known].numpy())
    return float(costs.sum()), (scipy.sparse.coo_array(entries, shape=(size, size)).tocsc(), gradient)


def _step(T_wc: pp.LieTensor, system: _System, damping: float, free: Tensor) -> pp.LieTensor:
    H, gradient = system
    damped = H + scipy.sparse.diags_array(damping * H.diagonal() + 1e-9)  # 1e-9: for poses without any edge
    # Symmetric and positive definite: the ordering may be symmetric, and no pivot need be looked for.
    factors = scipy.sparse.linalg.splu(
        damped.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
    xi = torch.from_numpy(factors.solve(-gradient.numpy())).reshape(-1, 6)
    moved = T_wc.tensor().clone()
    moved[free] = (T_wc[free] @ pp.se3(xi).Exp()).tensor()
    return pp.SE3(moved)
