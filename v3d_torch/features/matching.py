"""Matching of binary descriptors: exhaustive, or only near the projections of landmarks."""

from __future__ import annotations

import numpy as np
import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.config import OdometryConfig
from v3d_torch.kernels import descriptors as descriptor_kernels
from v3d_torch.kernels import projection_matching as projection_kernels
from v3d_torch.kernels.compiler import compiled_by, to_array

MAX_HAMMING, MAX_RATIO = OdometryConfig().max_hamming, OdometryConfig().max_ratio
"""Default thresholds, those of the odometry section of the configuration."""

_BYTES = 32
"""Bytes of an ORB descriptor."""

_CELL = 8.0
"""Side of the cells of the search grid, pixels: about half a search radius, so that few pixels are candidates."""

_MAX_DISTANCE = 1 << 9
"""Factor that combines a landmark and a distance into one sort key; larger than any Hamming distance, bits."""


def hamming_distance(a: Tensor, b: Tensor) -> Tensor:
    """Hamming distance between corresponding descriptors.

    Args:
        a: Descriptors, uint8, shape :math:`(N, 32)`.
        b: Descriptors, uint8, shape :math:`(N, 32)`.

    Returns:
        Number of different bits, int64, shape :math:`(N,)`.
    """
    return torch.from_numpy(np.bitwise_count(_as_words(a) ^ _as_words(b))).sum(dim=1)


def _as_words(descriptors: Tensor) -> NDArray[np.uint64]:
    """Descriptors (N, 32) as 64-bit words (N, 4)."""
    return descriptors.contiguous().numpy().view(np.uint64)


def _are_descriptors(*tensors: Tensor) -> bool:
    """Check whether all tensors have the type and shape of 256-bit descriptors."""
    return all(tensor.dtype == torch.uint8 and tensor.shape[1:] == (32,) for tensor in tensors)


def _match_descriptors_compiled(
    a: Tensor,
    b: Tensor,
    a_valid: Tensor | None = None,
    b_valid: Tensor | None = None,
    *,
    max_hamming: int = MAX_HAMMING,
    max_ratio: float = MAX_RATIO,
) -> Tensor:
    if a.dtype != torch.uint8 or b.dtype != torch.uint8 or a.shape[-1] != _BYTES or a.shape[:-2] != b.shape[:-2]:
        return NotImplemented
    matches = torch.full(a.shape[:-1], -1)
    for index in np.ndindex(a.shape[:-2]):
        rows, columns = (
            None if valid is None else valid.expand(each.shape[:-1])[index].nonzero()[:, 0]
            for each, valid in ((a, a_valid), (b, b_valid))
        )
        queries, candidates = (
            each[index] if chosen is None else each[index][chosen] for each, chosen in ((a, rows), (b, columns))
        )
        if min(len(queries), len(candidates)) < 2:
            continue
        words = _as_words(queries), _as_words(candidates)
        row, column = torch.from_numpy(descriptor_kernels.match_descriptors(*words, max_hamming, max_ratio)).unbind(1)
        matches[index][row if rows is None else rows[row]] = column if columns is None else columns[column]
    return matches


@compiled_by(_match_descriptors_compiled)
def match_descriptors(
    a: Tensor,
    b: Tensor,
    a_valid: Tensor | None = None,
    b_valid: Tensor | None = None,
    *,
    max_hamming: int = MAX_HAMMING,
    max_ratio: float = MAX_RATIO,
) -> Tensor:
    """Match binary descriptors: mutual nearest neighbours that pass Lowe's ratio test.

    Of several neighbours at the same distance, the first counts as nearest. Memory grows with N times M. Descriptors
    are binary, as those of ORB (Rublee et al., ICCV 2011). The ratio test is that of Lowe, Distinctive Image Features
    from Scale-Invariant Keypoints, IJCV 2004.

    Args:
        a: Descriptors, uint8, shape :math:`(*, N, D)`, 8 D bits.
        b: Descriptors, uint8, shape :math:`(*, M, D)`.
        a_valid: Mask of the descriptors of ``a`` that are not padding, bool, shape :math:`(*, N)`; None for all.
        b_valid: Mask of the descriptors of ``b`` that are not padding, bool, shape :math:`(*, M)`; None for all.
        max_hamming: Maximum Hamming distance, bits.
        max_ratio: Maximum ratio of the best to the second-best distance.

    Returns:
        Row of ``b`` that each row of ``a`` matches, -1 for none, int64, shape :math:`(*, N)`. There are no matches if
        ``a`` or ``b`` has fewer than two descriptors.
    """
    KORNIA_CHECK_SHAPE(a, ["*", "N", "D"])
    KORNIA_CHECK_SHAPE(b, ["*", "M", str(a.shape[-1])])
    distance = _pairwise_hamming_distances(a, b)
    if 0 in distance.shape[-2:]:
        return distance.new_full(distance.shape[:-1], -1, dtype=torch.int64)
    a_valid = distance.new_ones(a.shape[-2], dtype=torch.bool) if a_valid is None else a_valid
    b_valid = distance.new_ones(b.shape[-2], dtype=torch.bool) if b_valid is None else b_valid
    enough = (a_valid.sum(dim=-1) >= 2) & (b_valid.sum(dim=-1) >= 2)
    never = 8 * a.shape[-1] + 1  # exceeds all distances
    distance = torch.where(a_valid[..., :, None] & b_valid[..., None, :], distance, never)
    best, nearest = distance.min(dim=-1)
    second = distance.scatter(-1, nearest[..., None], never).amin(dim=-1)
    row = torch.arange(a.shape[-2], device=a.device)
    mutual = distance.argmin(dim=-2).gather(-1, nearest) == row
    accepted = mutual & (best <= max_hamming) & (best < max_ratio * second) & enough[..., None]
    return torch.where(accepted, nearest, -1)


def _pairwise_hamming_distances(a: Tensor, b: Tensor) -> Tensor:
    """Hamming distances of all pairs of descriptors (..., N, D) and (..., M, D), float32, (..., N, M).

    Each descriptor is a vector of +1 and -1, one for each bit. The scalar product of two of them is the number of equal
    bits minus the number of different bits. The sums are whole numbers and exact in float32.
    """
    place = torch.arange(8, dtype=torch.uint8, device=a.device)
    signs = [((each[..., None] >> place & 1).to(torch.float32) * 2 - 1).flatten(-2) for each in (a, b)]
    return (8 * a.shape[-1] - signs[0] @ signs[1].mT) / 2


class DescriptorMatcher(torch.nn.Module):
    """:func:`match_descriptors` as a module.

    Args:
        max_hamming: Maximum Hamming distance, bits.
        max_ratio: Maximum ratio of the best to the second-best distance.
    """

    def __init__(self, max_hamming: int = MAX_HAMMING, max_ratio: float = MAX_RATIO) -> None:
        super().__init__()
        self.max_hamming = max_hamming
        self.max_ratio = max_ratio

    def forward(self, a: Tensor, b: Tensor, a_valid: Tensor | None = None, b_valid: Tensor | None = None) -> Tensor:
        """Match descriptors :math:`(*, N, D)` and :math:`(*, M, D)`; see :func:`match_descriptors`."""
        return match_descriptors(a, b, a_valid, b_valid, max_hamming=self.max_hamming, max_ratio=self.max_ratio)


def _match_by_projection_compiled(
    projected: Tensor,
    radius: Tensor,
    levels: Tensor,
    descriptors: Tensor,
    uv: Tensor,
    octave: Tensor,
    candidates: Tensor,
    *,
    max_hamming: int,
    max_ratio: float,
) -> Tensor:
    types = {projected.dtype, radius.dtype, uv.dtype}, {levels.dtype, octave.dtype}
    if types != ({torch.float64}, {torch.int64}) or not _are_descriptors(descriptors, candidates):
        return NotImplemented
    if uv.shape[0] == 0:
        return torch.zeros(0, 2, dtype=torch.int64)
    pairs = projection_kernels.match_by_projection(
        to_array(projected),
        to_array(radius),
        to_array(levels),
        _as_words(descriptors),
        to_array(uv),
        to_array(octave),
        _as_words(candidates),
        max_hamming,
        max_ratio,
        _CELL,
    )
    return torch.from_numpy(pairs)


@compiled_by(_match_by_projection_compiled)
def match_by_projection(
    projected: Tensor,
    radius: Tensor,
    levels: Tensor,
    descriptors: Tensor,
    uv: Tensor,
    octave: Tensor,
    candidates: Tensor,
    *,
    max_hamming: int,
    max_ratio: float,
) -> Tensor:
    """Match landmarks to the features near their projections (Mur-Artal and Tardos, ORB-SLAM2, Sec. III).

    Args:
        projected: Projection of each landmark, pixels, shape :math:`(L, 2)`.
        radius: Search radius around each projection, pixels, shape :math:`(L,)`.
        levels: Expected pyramid level of each landmark, int64, shape :math:`(L,)`; a feature's level can differ by one.
        descriptors: Descriptors of the landmarks, uint8, shape :math:`(L, 32)`.
        uv: Pixels of the features, shape :math:`(N, 2)`.
        octave: Pyramid levels of the features, int64, shape :math:`(N,)`.
        candidates: Descriptors of the features, uint8, shape :math:`(N, 32)`.
        max_hamming: Maximum Hamming distance, bits.
        max_ratio: Maximum ratio of the best to the second-best distance among the candidates of a landmark.

    Returns:
        Pairs (landmark, feature), int64, shape :math:`(K, 2)`, sorted by landmark. Each landmark and each feature
        occurs at most once.
    """
    landmark, feature = _pairs_within(projected.T.contiguous().numpy(), radius.numpy(), uv.T.contiguous().numpy())
    same_level = np.flatnonzero(np.abs(levels.numpy()[landmark] - octave.numpy()[feature]) <= 1)
    landmark, feature = landmark[same_level], feature[same_level]
    landmark_rows, feature_rows = (torch.from_numpy(rows) for rows in (landmark, feature))
    # index_select is faster than indexing here.
    distance = hamming_distance(
        descriptors.index_select(0, landmark_rows), candidates.index_select(0, feature_rows)
    ).numpy()

    # Best and second-best candidate of each landmark.
    order = np.argsort(landmark * _MAX_DISTANCE + distance, kind="stable")
    landmark, feature, distance = landmark[order], feature[order], distance[order]
    second = np.append(np.where(landmark[1:] == landmark[:-1], distance[1:], np.inf), np.inf)[: len(order)]
    accepted = _is_first(landmark) & (distance <= max_hamming) & (distance <= max_ratio * second)
    landmark, feature, distance = landmark[accepted], feature[accepted], distance[accepted]

    # Best landmark of each feature; the lower index wins ties, so that the result is deterministic.
    order = np.lexsort((landmark, distance, feature))
    best = np.sort(order[_is_first(feature[order])])
    return torch.from_numpy(np.stack([landmark[best], feature[best]], axis=1))


def _is_first(values: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Mask of the first occurrence of each value in a sorted array, (N,)."""
    return np.concatenate([np.ones(len(values[:1]), dtype=np.bool_), values[1:] != values[:-1]])


def _pairs_within(
    centre: NDArray[np.float64], radius: NDArray[np.float64], uv: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """All pairs of a centre (2, L) and a pixel (2, N) within its radius (L,), sorted by centre.

    The pixels are sorted by the cells of a grid, row by row, so that the pixels of neighbouring cells in a row are
    contiguous.
    """
    if not centre.size or not uv.size:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    origin = uv.min(axis=1, keepdims=True)
    column, row = _cells(uv - origin)
    last_column, last_row = column.max(), row.max()
    width, count = last_column + 1, len(row)
    key = row * width + column
    order = np.sort(key * count + np.arange(count)) % count  # an argsort by key; sorting numbers is faster
    begin = np.append(0, np.bincount(key, minlength=width * (last_row + 1)).cumsum())  # start of each cell in `order`
    (left, top), (right, bottom) = _cells(centre - origin - radius), _cells(centre - origin + radius)
    left, top = np.maximum(left, 0), np.maximum(top, 0)
    right, bottom = np.minimum(right, last_column), np.minimum(bottom, last_row)
    # One range of grid rows per centre, then one range of pixels per centre and grid row.
    centre_index, rows = _expand_ranges(top, np.where(left <= right, bottom + 1, top))
    rows *= width
    range_index, position = _expand_ranges(begin[rows + left[centre_index]], begin[rows + right[centre_index] + 1])
    centre_index, pixel = centre_index[range_index], order[position]
    u, v = (uv[axis].take(pixel) - centre[axis].take(centre_index) for axis in (0, 1))
    near = np.flatnonzero(u * u + v * v <= (radius * radius).take(centre_index))
    return centre_index[near], pixel[near]


def _cells(pixels: NDArray[np.float64]) -> NDArray[np.int64]:
    """Grid cells (column, row) of pixels relative to the grid's origin, both (2, N)."""
    return np.floor(pixels / _CELL).astype(np.int64)


def _expand_ranges(first: NDArray[np.int64], last: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Concatenate the integer ranges from ``first`` to before ``last``; returns range index and value of each entry."""
    count = np.maximum(last - first, 0)
    range_index = np.repeat(np.arange(len(count)), count)
    return range_index, np.arange(len(range_index)) - (count.cumsum() - count - first)[range_index]
