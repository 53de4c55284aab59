"""Exhaustive matching of binary descriptors."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.config import OdometryConfig
from v3d_torch.errors import InputError
from v3d_torch.geometry.argument_checks import (
    check_counts,
    check_masks,
    check_not_jit_traced,
    check_not_negative,
    is_count,
)
from v3d_torch.geometry.precision import without_autocast
from v3d_torch.geometry.settings_module import SettingsModule
from v3d_torch.kernels import descriptors as descriptor_kernels
from v3d_torch.kernels.compiler import compiled_by
from v3d_torch.runtime.batches import check_shapes, common_batch

MAX_HAMMING, MAX_RATIO = OdometryConfig().max_hamming, OdometryConfig().max_ratio
"""Default thresholds, those of the odometry section of the configuration."""

_BYTES = 32
"""Bytes of an ORB descriptor."""


def hamming_distance(a: Tensor, b: Tensor) -> Tensor:
    """Hamming distance between corresponding descriptors.

    Args:
        a: Descriptors, uint8, shape :math:`(N, 32)`.
        b: Descriptors, uint8, shape :math:`(N, 32)`.

    Returns:
        Number of different bits, int64, shape :math:`(N,)`.
    """
    return torch.from_numpy(np.bitwise_count(as_words(a) ^ as_words(b))).sum(dim=1)


def as_words(descriptors: Tensor) -> NDArray[np.uint64]:
    """Descriptors (N, 32) as 64-bit words (N, 4)."""
    return descriptors.contiguous().numpy().view(np.uint64)


def are_descriptors(*tensors: Tensor) -> bool:
    """Check whether all tensors have the type and shape of 256-bit descriptors."""
    return all(tensor.dtype == torch.uint8 and tensor.shape[1:] == (_BYTES,) for tensor in tensors)


def _match_descriptors_compiled(
    a: Tensor,
    b: Tensor,
    a_valid: Tensor | None = None,
    b_valid: Tensor | None = None,
    *,
    max_hamming: int = MAX_HAMMING,
    max_ratio: float = MAX_RATIO,
) -> Tensor:
    if not is_count(max_hamming) or not max_ratio >= 0:
        return NotImplemented
    if any(each.dtype != torch.uint8 or each.ndim < 2 or each.shape[-1] != _BYTES for each in (a, b)):
        return NotImplemented
    if any(valid is not None and valid.dtype != torch.bool for valid in (a_valid, b_valid)):
        return NotImplemented
    if any(v is not None and v.shape[-1:] != each.shape[-2:-1] for each, v in ((a, a_valid), (b, b_valid))):
        return NotImplemented
    batch = common_batch(a=(a, 2), b=(b, 2), a_valid=(a_valid, 1), b_valid=(b_valid, 1))
    a, b = (each.expand(*batch, *each.shape[-2:]) for each in (a, b))
    matches = torch.full(a.shape[:-1], -1)
    for index in np.ndindex(batch):
        rows, columns = (
            None if valid is None else valid.expand(each.shape[:-1])[index].nonzero()[:, 0]
            for each, valid in ((a, a_valid), (b, b_valid))
        )
        queries, candidates = (
            each[index] if chosen is None else each[index][chosen] for each, chosen in ((a, rows), (b, columns))
        )
        if min(len(queries), len(candidates)) < 2:
            continue
        words = as_words(queries), as_words(candidates)
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
        max_ratio: The best distance is less than this fraction of the second-best.

    Returns:
        Row of ``b`` that each row of ``a`` matches, -1 for none, int64, shape :math:`(*, N)`. There are no matches if
        ``a`` or ``b`` has fewer than two descriptors.

    Raises:
        InputError: If a mask is not bool, if descriptors are not uint8, or in `torch.jit.trace`.
        ConfigError: If a threshold is negative or NaN, or ``max_hamming`` is not a whole number.
    """
    check_not_jit_traced("match_descriptors")
    _check_thresholds(max_hamming, max_ratio)
    check_masks(a_valid=a_valid, b_valid=b_valid)
    for name, descriptors in (("a", a), ("b", b)):
        if descriptors.dtype != torch.uint8:
            raise InputError(f"{name} has the type {descriptors.dtype}; give binary descriptors of type torch.uint8")
    check_shapes(a=(a, "N", "D"), b=(b, "M", "D"), a_valid=(a_valid, "N"), b_valid=(b_valid, "M"))
    distance = _pairwise_hamming_distances(a, b)
    a_valid = distance.new_ones(a.shape[-2], dtype=torch.bool) if a_valid is None else a_valid
    b_valid = distance.new_ones(b.shape[-2], dtype=torch.bool) if b_valid is None else b_valid
    enough = (a_valid.sum(dim=-1) >= 2) & (b_valid.sum(dim=-1) >= 2)
    never = 8 * a.shape[-1] + 1  # exceeds all distances
    distance = torch.where(a_valid[..., :, None] & b_valid[..., None, :], distance, never)
    if 0 in distance.shape[-2:]:
        return distance.new_full(distance.shape[:-1], -1, dtype=torch.int64)
    best, nearest = distance.min(dim=-1)
    second = distance.scatter(-1, nearest[..., None], never).amin(dim=-1)
    row = torch.arange(a.shape[-2], device=a.device)
    mutual = distance.argmin(dim=-2).gather(-1, nearest) == row
    # A distance of exactly the maximum ratio is compared as by the kernel: in float32, the limit is rounded.
    is_distinct = best.to(torch.float64) < max_ratio * second.to(torch.float64)
    # Padding is never nearest, however large the thresholds are.
    accepted = mutual & (best < never) & (best <= max_hamming) & is_distinct & enough[..., None]
    return torch.where(accepted, nearest, -1)


def _check_thresholds(max_hamming: int, max_ratio: float) -> None:
    check_counts(max_hamming=max_hamming)
    check_not_negative(max_ratio=max_ratio)


@without_autocast
def _pairwise_hamming_distances(a: Tensor, b: Tensor) -> Tensor:
    """Hamming distances of all pairs of descriptors (..., N, D) and (..., M, D), float32, (..., N, M).

    Each descriptor is a vector of +1 and -1, one for each bit. The scalar product of two of them is the number of equal
    bits minus the number of different bits. The sums are whole numbers and exact in float32.
    """
    place = torch.arange(8, dtype=torch.uint8, device=a.device)
    signs = [((each[..., None] >> place & 1).to(torch.float32) * 2 - 1).flatten(-2) for each in (a, b)]
    return (8 * a.shape[-1] - signs[0] @ signs[1].mT) / 2


class DescriptorMatcher(SettingsModule):
    """:func:`match_descriptors` as a module.

    Args:
        max_hamming: Maximum Hamming distance, bits.
        max_ratio: The best distance is less than this fraction of the second-best.

    Raises:
        ConfigError: If a number is not possible; see :func:`match_descriptors`.
    """

    def __init__(self, max_hamming: int = MAX_HAMMING, max_ratio: float = MAX_RATIO) -> None:
        _check_thresholds(max_hamming, max_ratio)
        super().__init__()
        self.max_hamming = max_hamming
        self.max_ratio = max_ratio

    def forward(self, a: Tensor, b: Tensor, a_valid: Tensor | None = None, b_valid: Tensor | None = None) -> Tensor:
        """Match descriptors :math:`(*, N, D)` and :math:`(*, M, D)`; see :func:`match_descriptors`."""
        return match_descriptors(a, b, a_valid, b_valid, max_hamming=self.max_hamming, max_ratio=self.max_ratio)
