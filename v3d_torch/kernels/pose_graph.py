"""Kernel of the pose-graph optimisation; see `v3d_torch.backend.pose_graph`."""

from __future__ import annotations

import numpy as np

from v3d_torch.kernels import se3
from v3d_torch.kernels.arrays import Bools, Floats, Ints
from v3d_torch.kernels.block_cholesky import factorise, find_block, order_by_degree, solve_factorised
from v3d_torch.kernels.compiler import device, kernel
from v3d_torch.kernels.levenberg_marquardt import DampingSchedule, has_converged, next_damping
from v3d_torch.kernels.reprojection import huber, multiply, se3_exp


@device
def _linearise(
    T_wc: Floats, edges: Ints, T_ji: Floats, information: Floats, weights: Floats, limit: float, place: Ints,
    slots: Ints, blocks: Floats, g: Floats,
) -> float:  # fmt: skip
    """Return the robust cost; write the lower triangle of the normal equations and their right-hand sides."""
    blocks[:], g[:], cost = 0.0, 0.0, 0.0
    for e in range(len(edges)):
        T_ij = multiply(se3.invert(T_wc[edges[e, 0]]), T_wc[edges[e, 1]])
        error = se3.log(multiply(T_ji[e], T_ij))
        weighted, squared = np.zeros(6), 0.0
        for i in range(6):
            for k in range(6):
                weighted[i] += information[e, i, k] * error[k]
            squared += weighted[i] * error[i]
        robust, weight = huber(squared, limit)
        cost += weights[e] * robust
        weight *= weights[e]
        J_j = se3.right_jacobian_inverse(error)
        J = (-multiply(J_j, se3.adjoint(se3.invert(T_ij))), J_j)
        omega_J = (multiply(information[e], J[0]), multiply(information[e], J[1]))
        for end in range(2):
            row = place[edges[e, end]]
            if row < 0:
                continue
            for k in range(6):
                for i in range(6):
                    g[row, k] -= weight * J[end][i, k] * weighted[i]
            for other in range(2):
                slot = slots[e, end, other]
                if slot >= 0:
                    for i in range(6):
                        for k in range(6):
                            for m in range(6):
                                blocks[slot, k, m] += weight * J[end][i, k] * omega_J[other][i, m]
    return cost


@kernel("(f8[:,:,::1], i8[:,::1], f8[:,:,::1], f8[:,:,::1], f8[::1], b1[::1], f8, i8, f8, f8, UniTuple(f8, 4))")
def optimise_pose_graph(
    T_wc: Floats, edges: Ints, T_ji: Floats, information: Floats, weights: Floats, fixed: Bools, limit: float,
    iterations: int, tolerance: float, regularisation: float, damping_schedule: DampingSchedule,
) -> tuple[Floats, float, float, int, bool]:  # fmt: skip
    """Optimise the free poses of a graph by Levenberg-Marquardt.

    Args:
        T_wc: Initial poses, (N, 4, 4).
        edges: Indices (i, j) of the poses of each edge, (E, 2).
        T_ji: Inverse of the measured relative poses, (E, 4, 4).
        information: Inverse covariances of the errors, (E, 6, 6).
        weights: Weight of each edge, (E,).
        fixed: Mask of the fixed poses, (N,).
        limit: Squared error from which Huber's loss is linear.
        iterations: Maximum number of steps.
        tolerance: Relative change of the cost at convergence.
        regularisation: Added to the diagonal of the normal equations.
        damping_schedule: First, smallest and largest damping, and the factor between two steps.

    Returns:
        Poses (N, 4, 4), cost before and after, number of steps, and True if the optimisation converged.
    """
    free, place = np.nonzero(~fixed)[0], np.full(len(fixed), -1)
    place[free] = np.arange(len(free))
    adjacent = np.zeros((len(free), len(free)), np.bool_)
    for e in range(len(edges)):
        a, b = place[edges[e, 0]], place[edges[e, 1]]
        if a >= 0 and b >= 0 and a != b:
            adjacent[a, b] = adjacent[b, a] = True
    position, first, row = order_by_degree(adjacent)
    place[free] = position
    slots = np.full((len(edges), 2, 2), -1)  # block of each pair of ends; only those of the lower triangle
    for e in range(len(edges)):
        for i in range(2):
            for k in range(2):
                a, b = place[edges[e, i]], place[edges[e, k]]
                if a >= b >= 0:
                    slots[e, i, k] = find_block(first, row, a, b)
    blocks, g = np.empty((len(row), 6, 6)), np.empty((len(free), 6))
    new_blocks, new_g = np.empty((len(row), 6, 6)), np.empty((len(free), 6))
    cost = _linearise(T_wc, edges, T_ji, information, weights, limit, place, slots, blocks, g)
    damping, cost_before, iteration, converged = damping_schedule[0], cost, 0, False
    while iteration < iterations and not converged:
        factor, xi, new_T = blocks.copy(), g.copy(), T_wc.copy()
        for k in range(len(free)):
            for i in range(6):
                diagonal = factor[first[k], i, i]
                factor[first[k], i, i] = diagonal * (1 + damping) + regularisation
        factorise(first, row, factor)
        solve_factorised(first, row, factor, xi)
        for each in free:
            new_T[each] = multiply(T_wc[each], se3_exp(xi[place[each]]))
        new_cost = _linearise(new_T, edges, T_ji, information, weights, limit, place, slots, new_blocks, new_g)
        iteration += 1
        converged = has_converged(cost, new_cost, damping, tolerance)
        damping = next_damping(damping, new_cost < cost, damping_schedule)
        if new_cost < cost:
            T_wc, cost = new_T, new_cost
            blocks, new_blocks, g, new_g = new_blocks, blocks, new_g, g
    return T_wc, cost_before, cost, iteration, converged
