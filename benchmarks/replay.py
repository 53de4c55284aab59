"""Frames of a sequence in an order of choice: its beginning, or forth and back for as long as one likes."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from v3d_torch.datasets import RGBDSequence
from v3d_torch.datasets.stored import StoredSequence


class Replay(StoredSequence):
    """Frames of another sequence, without its ground truth and masks.

    Time goes on by as much as lies between two frames in the other, in whichever direction.

    Args:
        sequence: that has the frames.
        indices: of the frames, no two neighbours equal, at least one.
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


def forth_and_back(count: int, frames: int) -> list[int]:
    """Indices that go through ``count`` frames forth, back, and so on, until there are ``frames`` of them."""
    period = max(2 * (count - 1), 1)
    return [min(index % period, period - index % period) for index in range(frames)]
