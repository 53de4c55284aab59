"""Chamfer distance between padded batches of clouds: motion within an object (paper, Sec. III-D)."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.errors import InputError

_KD_TREE: dict[str, bool | int | float | str] = {"algorithm": 4}
"""FLANN's exact tree for few dimensions, FLANN_INDEX_KDTREE_SINGLE: takes half the time of SciPy's."""

_FARTHEST = 1e18
"""Metres: squared distances between coordinates beyond it overflow in float32."""

_WORTH_THREADS = 20_000
"""Points, which keep one thread busy for some milliseconds: much longer than it takes to start another."""


def chamfer_distance(p: Tensor, q: Tensor, p_valid: Tensor | None = None, q_valid: Tensor | None = None) -> Tensor:
    r"""Mean squared distance to the nearest point of the other cloud, both ways added.

    .. math::
        D(P, Q) = \frac{1}{|P|} \sum_{p \in P} \min_{q \in Q} \|p - q\|^2
                + \frac{1}{|Q|} \sum_{q \in Q} \min_{p \in P} \|q - p\|^2

    Nearest points are found with KD-trees, so that memory is linear in the number of points. They work in float32: of
    two points whose distances differ by less than 1e-6 of the extent of the clouds, either may be the nearest. The
    distance to it is taken from coordinate differences in the dtype of the clouds.

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
    p_points, p_sizes = _present(p, p_valid)
    q_points, q_sizes = _present(q, q_valid)
    points, sizes = torch.cat([p_points, q_points]), np.concatenate([p_sizes, q_sizes])
    nearest = torch.from_numpy(_nearest(points.detach().numpy(), sizes))
    x, y, z = (points - points.index_select(0, nearest)).square().unbind(dim=1)
    # Added one after the other and in float64: the same bytes from any number of threads.
    cloud = torch.from_numpy(np.arange(len(sizes)).repeat(sizes))
    sums = x.new_zeros(len(sizes), dtype=torch.float64).index_add(0, cloud, (x + y + z).to(torch.float64))
    return (sums / torch.from_numpy(sizes)).reshape(2, -1).sum(dim=0).to(points.dtype)


def _present(points: Tensor, valid: Tensor | None) -> tuple[Tensor, NDArray[np.int64]]:
    """Points that exist, cloud after cloud, and how many each cloud has."""
    batch, count = points.shape[:2]
    rows = points.reshape(-1, 3)
    if valid is None:
        return rows, np.full(batch, count)
    KORNIA_CHECK_SHAPE(valid, [str(batch), str(count)])
    mask = valid.numpy()
    return rows.index_select(0, torch.from_numpy(np.flatnonzero(mask))), mask.sum(axis=1)


def _nearest(points: NDArray[np.floating], sizes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Index of the point of the other cloud that is nearest to each point; of the point itself where there is none.

    Args:
        points: all clouds P, then all clouds Q, shape (sum of sizes, 3).
        sizes: of the clouds, shape (2 B,).
    """
    nearest = np.arange(len(points))
    if not np.abs(points).max(initial=0) < _FARTHEST:
        raise InputError("A point of a cloud to be compared is not finite; mark points without depth as not valid.")
    batch = len(sizes) // 2
    ends = sizes.cumsum()
    if points.dtype != np.float32 and len(points):
        # Seen from the first point of P: float32 has too few digits for a cloud far from the origin.
        first = (ends - sizes)[:batch]
        origins = points.take(np.concatenate([first, first]), axis=0, mode="clip")
        points = (points - origins.repeat(sizes, axis=0)).astype(np.float32)
    clouds = [slice(end - size, end) for end, size in zip(ends.tolist(), sizes.tolist(), strict=True)]
    others = clouds[batch:] + clouds[:batch]
    threads = torch.get_num_threads() if len(points) >= _WORTH_THREADS else 1

    def search(share: int) -> None:
        for cloud, other in zip(clouds[share::threads], others[share::threads], strict=True):
            queries, targets = points[cloud], points[other]
            if len(queries) and len(targets):
                nearest[cloud] = cv2.flann.Index(targets, _KD_TREE).knnSearch(queries, 1)[0][:, 0] + other.start

    if threads == 1:
        search(0)
    else:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(search, range(threads)))
    return nearest


class ChamferDistance(torch.nn.Module):
    """:func:`chamfer_distance` as a module."""

    def forward(self, p: Tensor, q: Tensor, p_valid: Tensor | None = None, q_valid: Tensor | None = None) -> Tensor:
        """Square metres between clouds :math:`(B, N, 3)` and :math:`(B, M, 3)`; see :func:`chamfer_distance`."""
        return chamfer_distance(p, q, p_valid, q_valid)
