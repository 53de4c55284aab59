"""Chamfer distance between padded batches of clouds: motion within an object (paper, Sec. III-D)."""

from __future__ import annotations

import numpy as np
import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from scipy.spatial import cKDTree
from torch import Tensor

from v3d_torch.errors import InputError


def chamfer_distance(p: Tensor, q: Tensor, p_valid: Tensor | None = None, q_valid: Tensor | None = None) -> Tensor:
    r"""Mean squared distance to the nearest point of the other cloud, both ways added.

    .. math::
        D(P, Q) = \frac{1}{|P|} \sum_{p \in P} \min_{q \in Q} \|p - q\|^2
                + \frac{1}{|Q|} \sum_{q \in Q} \min_{p \in P} \|q - p\|^2

    Nearest points are found with a KD-tree in float64, so that memory is linear in the number of points; distances are
    taken from coordinate differences in the dtype of the clouds.

    Args:
        p: metres, float32 or float64, shape :math:`(B, N, 3)`.
        q: as ``p``, shape :math:`(B, M, 3)`.
        p_valid: which points of ``p`` exist, bool, shape :math:`(B, N)`; all by default.
        q_valid: which points of ``q`` exist, bool, shape :math:`(B, M)`; all by default.

    Returns:
        Square metres, shape :math:`(B,)`. NaN where one of the two clouds is empty: undefined, neither near nor far.
        Differentiable in ``p`` and ``q`` wherever the nearest point is unique.

    Raises:
        InputError: if a valid point is not finite.
    """
    KORNIA_CHECK_SHAPE(p, ["B", "N", "3"])
    KORNIA_CHECK_SHAPE(q, [str(p.shape[0]), "M", "3"])
    p_valid = torch.ones(p.shape[:2], dtype=torch.bool) if p_valid is None else p_valid
    q_valid = torch.ones(q.shape[:2], dtype=torch.bool) if q_valid is None else q_valid
    KORNIA_CHECK_SHAPE(p_valid, [str(size) for size in p.shape[:2]])
    KORNIA_CHECK_SHAPE(q_valid, [str(size) for size in q.shape[:2]])
    p_nearest, q_nearest = _nearest(p, q, p_valid, q_valid)
    return _mean_square(p, q, p_valid, p_nearest) + _mean_square(q, p, q_valid, q_nearest)


def _nearest(p: Tensor, q: Tensor, p_valid: Tensor, q_valid: Tensor) -> tuple[Tensor, Tensor]:
    """Index of the nearest valid point in the other cloud, (B, N) into ``q`` and (B, M) into ``p``; -1 = none."""
    p_nearest = torch.full(p_valid.shape, -1)
    q_nearest = torch.full(q_valid.shape, -1)
    for b in range(len(p)):
        p_index, q_index = p_valid[b].nonzero()[:, 0], q_valid[b].nonzero()[:, 0]
        p_points = p[b].detach()[p_index].to(torch.float64)
        q_points = q[b].detach()[q_index].to(torch.float64)
        if not (p_points.isfinite().all() and q_points.isfinite().all()):
            raise InputError("A point of a cloud to be compared is not finite; mark points without depth as not valid.")
        if len(p_index) and len(q_index):
            p_nearest[b, p_index] = q_index[_query(q_points.numpy(), p_points.numpy())]
            q_nearest[b, q_index] = p_index[_query(p_points.numpy(), q_points.numpy())]
    return p_nearest, q_nearest


def _query(target: np.ndarray, points: np.ndarray) -> Tensor:
    """Index of the point of ``target`` nearest to each of ``points``."""
    return torch.from_numpy(cKDTree(target, balanced_tree=False).query(points)[1])


def _mean_square(points: Tensor, target: Tensor, valid: Tensor, nearest: Tensor) -> Tensor:
    """Mean over the valid points of the squared distance to their nearest target, shape (B,); NaN without any pair."""
    paired = valid & (nearest >= 0)
    cloud, index = paired.nonzero(as_tuple=True)
    squares = (points[cloud, index] - target[cloud, nearest[cloud, index]]).square().sum(dim=-1)
    return points.new_zeros(paired.shape).index_put((cloud, index), squares).sum(dim=1) / paired.sum(dim=1)


class ChamferDistance(torch.nn.Module):
    """:func:`chamfer_distance` as a module."""

    def forward(self, p: Tensor, q: Tensor, p_valid: Tensor | None = None, q_valid: Tensor | None = None) -> Tensor:
        """Square metres between clouds :math:`(B, N, 3)` and :math:`(B, M, 3)`; see :func:`chamfer_distance`."""
        return chamfer_distance(p, q, p_valid, q_valid)
