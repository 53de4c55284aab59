"""Chamfer distance between padded batches of point clouds (paper, Sec. III-D)."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.errors import InputError
from v3d_torch.geometry.argument_checks import check_masks, check_shape
from v3d_torch.geometry.precision import result_dtype, working_dtype
from v3d_torch.kernels.compiler import can_read
from v3d_torch.runtime.batches import mask_or_all

_KD_TREE: dict[str, bool | int | float | str] = {"algorithm": 4}
"""FLANN_INDEX_KDTREE_SINGLE, an exact KD-tree for few dimensions; faster here than the one of SciPy."""

_MAX_COORDINATE = 1e18
"""Maximum coordinate, metres: squared distances between larger coordinates overflow in float32."""

_CHUNK = 1024
"""Number of points compared with all others at once; it bounds the memory."""

_MIN_POINTS_FOR_THREADS = 20_000
"""Number of points from which the search uses several threads: it then takes much longer than starting a thread."""


def chamfer_distance(p: Tensor, q: Tensor, p_valid: Tensor | None = None, q_valid: Tensor | None = None) -> Tensor:
    r"""Chamfer distance between point clouds P and Q: sum of both mean squared nearest-neighbour distances.

    .. math::
        D(P, Q) = \frac{1}{|P|} \sum_{p \in P} \min_{q \in Q} \|p - q\|^2
                + \frac{1}{|Q|} \sum_{q \in Q} \min_{p \in P} \|q - p\|^2

    On the CPU, KD-trees find the nearest points, so that memory is linear in the number of points. The search uses
    float32: if two distances differ by less than 1e-6 of the extent of the clouds, either point can be returned as the
    nearest. The distance to this point is computed in the dtype of the clouds. On other devices, and if torch traces
    the computation, all pairs of points are compared.

    Args:
        p: Point clouds P, metres, shape :math:`(B, N, 3)`.
        q: Point clouds Q, metres, dtype of ``p``, shape :math:`(B, M, 3)`.
        p_valid: Mask of the points of ``p`` that are not padding, bool, shape :math:`(B, N)`; None for all.
        q_valid: Mask of the points of ``q`` that are not padding, bool, shape :math:`(B, M)`; None for all.

    Returns:
        Chamfer distances, square metres, dtype of ``p``, float32 for integers, shape :math:`(B,)`; NaN if one of the
        two clouds is empty. Differentiable in ``p`` and ``q`` if the nearest points are unique.

    Raises:
        InputError: If a coordinate of a valid point is not finite or exceeds 1e18 m, or if a mask is not bool.
    """
    check_masks(p_valid=p_valid, q_valid=q_valid)
    check_shape("p", p, "B", "N", 3)
    check_shape("q", q, p.shape[0], "M", 3)
    p_valid, q_valid = mask_or_all(p_valid, p[..., 0]), mask_or_all(q_valid, q[..., 0])
    check_shape("p_valid", p_valid, *p.shape[:2])
    check_shape("q_valid", q_valid, *q.shape[:2])
    dtype = p.dtype
    # Padding is set to the origin: NaN would reach the gradients.
    p, q = (
        torch.where(valid[..., None], points.to(working_dtype(dtype)), 0.0)
        for points, valid in ((p, p_valid), (q, q_valid))
    )
    if can_read(p) and can_read(q):
        nearest_q, nearest_p = _search_trees(p, q, p_valid, q_valid)
    else:
        nearest_q, nearest_p = _search_all(p, q, q_valid), _search_all(q, p, p_valid)
    means = [
        _mean_square(p, q, nearest_q, p_valid, q_valid),
        _mean_square(q, p, nearest_p, q_valid, p_valid),
    ]
    return (means[0] + means[1]).to(result_dtype(dtype))


def _mean_square(points: Tensor, others: Tensor, nearest: Tensor, valid: Tensor, others_valid: Tensor) -> Tensor:
    """Mean squared distance of each cloud's points (B, N, 3) to the points of the other cloud with indices (B, N)."""
    batch, count = nearest.shape
    if 0 in (count, others.shape[1]):
        return points.new_full((batch,), torch.nan, dtype=torch.float64)
    cloud = torch.arange(batch, device=points.device)[:, None]
    # Without a nearest point, as the other cloud is empty, the index is that of the point, which can be too large.
    row = (nearest.clamp(max=others.shape[1] - 1) + others.shape[1] * cloud).flatten()
    partner = others.reshape(-1, 3).index_select(0, row).reshape(points.shape)
    x, y, z = (points - partner).square().unbind(dim=2)
    squared = torch.where(valid & others_valid.any(dim=1, keepdim=True), x + y + z, 0.0).to(torch.float64)
    # Sequential sums in float64: the result does not depend on the number of threads.
    sums = squared.new_zeros(batch).index_add(0, cloud.expand(batch, count).flatten(), squared.flatten())
    size = torch.where(others_valid.any(dim=1), valid.sum(dim=1), 0)
    return torch.where(size > 0, sums / size.clamp(min=1), torch.nan)


def _search_all(points: Tensor, others: Tensor, others_valid: Tensor) -> Tensor:
    """Index of the valid point of the other cloud that is nearest to each point, (B, N), from all pairs of points."""
    if others.shape[1] == 0:
        return torch.zeros_like(points[..., 0], dtype=torch.int64)
    indices = []
    for some in points.detach().split(_CHUNK, dim=1):
        axes = zip(some.unbind(dim=2), others.detach().unbind(dim=2), strict=True)
        squared = sum((a[:, :, None] - b[:, None, :]).square() for a, b in axes)
        indices.append(torch.where(others_valid[:, None, :], squared, torch.inf).argmin(dim=2))
    return torch.cat(indices, dim=1)


def _search_trees(p: Tensor, q: Tensor, p_valid: Tensor, q_valid: Tensor) -> tuple[Tensor, Tensor]:
    """Index of the nearest point of the other cloud for each point of P, (B, N), and of Q, (B, M), from KD-trees."""
    masks = [valid.numpy() for valid in (p_valid, q_valid)]
    rows = [np.flatnonzero(mask) for mask in masks]
    coordinates = [
        each.detach().numpy().reshape(-1, 3).take(row, axis=0) for each, row in zip((p, q), rows, strict=True)
    ]
    nearest = _nearest_points(np.concatenate(coordinates), np.concatenate([mask.sum(axis=1) for mask in masks]))
    column = np.concatenate([row % max(mask.shape[1], 1) for row, mask in zip(rows, masks, strict=True)])[nearest]
    indices, first = [], 0
    for mask, row in zip(masks, rows, strict=True):
        index = np.zeros(mask.shape, np.int64)
        index.ravel()[row] = column[first : first + len(row)]
        indices.append(torch.from_numpy(index))
        first += len(row)
    return indices[0], indices[1]


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
        raise InputError(
            f"chamfer_distance: a valid point is not finite, or farther away than {_MAX_COORDINATE:g} m; mark points"
            " without depth as invalid"
        )
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
