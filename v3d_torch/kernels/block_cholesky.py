"""Sparse Cholesky factorisation with 6x6 blocks: part of the kernel of pose graphs.

A. George and J. Liu, Computer Solution of Large Sparse Positive Definite Systems, 1981.
"""

from __future__ import annotations

import math

import numpy as np

from v3d_torch.kernels.arrays import Bools, Floats, Ints
from v3d_torch.kernels.compiler import device


@device
def order_by_degree(adjacent: Bools) -> tuple[Ints, Ints, Ints]:
    """Order the rows of a symmetric matrix by minimum degree, which keeps the factor sparse.

    Args:
        adjacent: Mask of the blocks that are not 0, without the diagonal, (n, n); blocks that the factorisation fills
            are added.

    Returns:
        Position of each row in the order (n,), and the lower triangle of the factor by columns, rows and columns
        numbered by position: the first block of each column, which is on its diagonal, (n + 1,), and the row of each
        block, ascending in each column.
    """
    n = len(adjacent)
    position, order, degree, columns = np.full(n, -1), np.empty(n, np.int64), np.zeros(n, np.int64), np.ones(n + 1)
    neighbours = np.empty(n, np.int64)
    for a in range(n):
        degree[a] = adjacent[a].sum()
    for step in range(n):
        chosen, count = -1, 0
        for a in range(n):
            if position[a] < 0 and (chosen < 0 or degree[a] < degree[chosen]):
                chosen = a
        position[chosen], order[step] = step, chosen
        for a in range(n):
            if adjacent[chosen, a] and position[a] < 0:
                neighbours[count] = a
                count += 1
        columns[step] = count + 1
        for a in neighbours[:count]:
            degree[a] -= 1
            for b in neighbours[:count]:
                if a != b and not adjacent[a, b]:
                    adjacent[a, b] = True
                    degree[a] += 1
    first = np.zeros(n + 1, np.int64)
    for k in range(n):
        first[k + 1] = first[k] + columns[k]
    row, count = np.empty(first[n], np.int64), 0
    for k in range(n):
        for i in range(k, n):
            if i == k or adjacent[order[k], order[i]]:
                row[count] = i
                count += 1
    return position, first, row


@device
def find_block(first: Ints, row: Ints, i: int, k: int) -> int:
    """Index of the block in row i and column k."""
    return first[k] + np.searchsorted(row[first[k] : first[k + 1]], i)


@device
def factorise(first: Ints, row: Ints, blocks: Floats) -> None:
    """Replace the lower triangle of a positive definite matrix, (blocks, 6, 6), by its Cholesky factor.

    NaN results if the matrix is not positive definite.
    """
    for k in range(len(first) - 1):
        D, end = blocks[first[k]], first[k + 1]
        for i in range(6):
            for j in range(i + 1):
                rest = D[i, j]
                for m in range(j):
                    rest -= D[i, m] * D[j, m]
                D[i, j] = math.sqrt(rest) if i == j else rest / D[j, j]
        for p in range(first[k] + 1, end):
            L = blocks[p]
            for i in range(6):
                for j in range(6):
                    rest = L[i, j]
                    for m in range(j):
                        rest -= L[i, m] * D[j, m]
                    L[i, j] = rest / D[j, j]
        for q in range(first[k] + 1, end):
            target = first[row[q]]
            for p in range(q, end):
                while row[target] < row[p]:
                    target += 1
                for i in range(6):
                    for j in range(6):
                        total = 0.0
                        for m in range(6):
                            total += blocks[p, i, m] * blocks[q, j, m]
                        blocks[target, i, j] -= total


@device
def solve_factorised(first: Ints, row: Ints, blocks: Floats, b: Floats) -> None:
    """Replace the right-hand sides b, (n, 6), by the solution."""
    n = len(first) - 1
    for k in range(n):
        D = blocks[first[k]]
        for i in range(6):
            for m in range(i):
                b[k, i] -= D[i, m] * b[k, m]
            b[k, i] /= D[i, i]
        for p in range(first[k] + 1, first[k + 1]):
            for i in range(6):
                for m in range(6):
                    b[row[p], i] -= blocks[p, i, m] * b[k, m]
    for k in range(n - 1, -1, -1):
        D = blocks[first[k]]
        for p in range(first[k] + 1, first[k + 1]):
            for i in range(6):
                for m in range(6):
                    b[k, m] -= blocks[p, i, m] * b[row[p], i]
        for i in range(5, -1, -1):
            for m in range(i + 1, 6):
                b[k, i] -= D[m, i] * b[k, m]
            b[k, i] /= D[i, i]
