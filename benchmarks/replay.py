"""Frames of a sequence in a given order: its beginning, again and again, or forwards and backwards."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from v3d_torch.datasets import RGBDSequence
from v3d_torch.datasets.stored import StoredSequence


class Replay(StoredSequence):
    """Frames of another sequence, without its ground truth and masks.

    Time advances by the interval between the two frames in the other sequence, in either direction.

    Args:
        sequence: Sequence to take the frames from.
        indices: Indices of the frames, at least one; no two neighbours are equal.
    """

    def __init__(self, sequence: RGBDSequence, indices: Sequence[int]) -> None:
        stamps = sequence.stamps[torch.tensor(indices)]
        times = torch.cat([stamps[:1], stamps[0] + stamps.diff().abs().cumsum(dim=0)])
        super().__init__(sequence.name, times.tolist(), sequence.camera)
        self._sequence = sequence
        self._indices = indices

    def _read(self, index: int) -> tuple[Tensor, Tensor]:
        frame = self._sequence[self._indices[index]]
        return frame.image, frame.depth


def again_and_again(count: int, frames: int) -> list[int]:
    """Return ``frames`` indices that run through ``count`` frames, and start again after the last one."""
    return [index % count for index in range(frames)]


def back_and_forth(count: int, frames: int) -> list[int]:
    """Return ``frames`` indices that run through ``count`` frames forwards, backwards, forwards and so on."""
    period = max(2 * (count - 1), 1)
    return [min(index % period, period - index % period) for index in range(frames)]
