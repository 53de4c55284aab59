"""Chamfer distance between padded batches of point clouds (paper, Sec. III-D)."""

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
"""FLANN_INDEX_KDTREE_SINGLE, an exact KD-tree for few dimensions; faster here than the one of SciPy."""

_MAX_COORDINATE = 1e18
"""Maximum coordinate, metres: squared distances between larger coordinates overflow in float32."""

_MIN_POINTS_FOR_THREADS = 20_000
"""Number of points from which the search uses several threads: it then takes much longer than starting a thread."""


def chamfer_distance(p: Tensor, q: Tensor, p_valid: Tensor | None = None, q_valid: Tensor | None = None) -> Tensor:
    r"""Chamfer distance between point clouds P and Q: sum of both mean squared nearest-neighbour distances.

    .. math::
        D(P, Q) = \frac{1}{|P|} \sum_{p \in P} \min_{q \in Q} \|p - q\|^2
                + \frac{1}{|Q|} \sum_{q \in Q} \min_{p \in P} \|q - p\|^2

    KD-trees find the nearest points, so that memory is linear in the number of points. The search uses float32: if two
    distances differ by less than 1e-6 of the extent of the clouds, either point can be returned as the nearest. The
    distance to this point is computed in the dtype of the clouds.

    Args:
        p: Point clouds P, metres, float32 or float64, shape :math:`(B, N, 3)`.
        q: Point clouds Q, metres, dtype of ``p``, shape :math:`(B, M, 3)`.
        p_valid: Mask of the points of ``p`` that are not padding, bool, shape :math:`(B, N)`; None for all.
        q_valid: Mask of the points of ``q`` that are not padding, bool, shape :math:`(B, M)`; None for all.

    Returns:
        Chamfer distances, square metres, shape :math:`(B,)`; NaN if one of the two clouds is empty. Differentiable in
        ``p`` and ``q`` if the nearest points are unique.

    Raises:
        InputError: If a valid point is not finite.
    """
    KORNIA_CHECK_SHAPE(p, ["B", "N", "3"])
    KORNIA_CHECK_SHAPE(q, [str(p.shape[0]), "M", "3"])
    p_points, p_sizes = _valid_points(p, p_valid)
    q_points, q_sizes = _valid_points(q, q_valid)
    points, sizes = torch.cat([p_points, q_points]), np.concatenate([p_sizes, q_sizes])
    nearest = torch.from_numpy(_nearest_points(points.detach().numpy(), sizes))
    x, y, z = (points - points.index_select(0, nearest)).square().unbind(dim=1)
    # Sequential sums in float64: the result does not depend on the number of threads.
    cloud = torch.from_numpy(np.arange(len(sizes)).repeat(sizes))
    sums = x.new_zeros(len(sizes), dtype=torch.float64).index_add(0, cloud, (x + y + z).to(torch.float64))
    return (sums / torch.from_numpy(sizes)).reshape(2, -1).sum(dim=0).to(points.dtype)


def _valid_points(points: Tensor, valid: Tensor | None) -> tuple[Tensor, NDArray[np.int64]]:
    """Return the valid points of all clouds in one list, shape (sum of sizes, 3), and the size of each cloud."""
    batch, count = points.shape[:2]
    rows = points.reshape(-1, 3)
    if valid is None:
        return rows, np.full(batch, count)
    KORNIA_CHECK_SHAPE(valid, [str(batch), str(count)])
    mask = valid.numpy()
    return rows.index_select(0, torch.from_numpy(np.flatnonzero(mask))), mask.sum(axis=1)


def _nearest_points(points: NDArray[np.floating], sizes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Find the nearest point of the other cloud for every point.

    Args:
        points: Points of all clouds P, then of all clouds Q, metres, shape (sum of sizes, 3).
        sizes: Number of points of each cloud, shape (2 B,).

    Returns:
        Index of the nearest point, shape (sum of sizes,); the index of the point itself if the other cloud is empty.
    """
    nearest = np.arange(len(points))
    if not np.abs(points).max(initial=0) < _MAX_COORDINATE:
        raise InputError("chamfer_distance: a valid point is not finite; mark points without depth as invalid")
    batch = len(sizes) // 2
    ends = sizes.cumsum()
    if points.dtype != np.float32 and len(points):
        # Relative to the first point of P: float32 has too few digits for a cloud far from the origin.
        first = (ends - sizes)[:batch]
        origins = points.take(np.concatenate([first, first]), axis=0, mode="clip")
        points = (points - origins.repeat(sizes, axis=0)).astype(np.float32)
    clouds = [slice(end - size, end) for end, size in zip(ends.tolist(), sizes.tolist(), strict=True)]
    others = clouds[batch:] + clouds[:batch]
    threads = torch.get_num_threads() if len(points) >= _MIN_POINTS_FOR_THREADS else 1

    def search(thread: int) -> None:
        for cloud, other in zip(clouds[thread::threads], others[thread::threads], strict=True):
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
        """Return the Chamfer distance of clouds :math:`(B, N, 3)` and :math:`(B, M, 3)`, square metres, :math:`(B,)`.

        See :func:`chamfer_distance`.
        """
        return chamfer_distance(p, q, p_valid, q_valid)
