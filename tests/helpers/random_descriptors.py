"""Random binary descriptors, and their neighbours in Hamming distance."""

from __future__ import annotations

import numpy as np
import torch


def random_descriptors(count: int, seed: int) -> torch.Tensor:
    return torch.randint(0, 256, (count, 32), generator=torch.Generator().manual_seed(seed), dtype=torch.uint8)


def invert_bits(descriptors: torch.Tensor, bits: int) -> torch.Tensor:
    """Descriptors with the first ``bits`` bits inverted."""
    unpacked = np.unpackbits(descriptors.numpy(), axis=1)
    unpacked[:, :bits] ^= 1
    return torch.from_numpy(np.packbits(unpacked, axis=1))
