"""Frames of a sequence in a given order: its beginning, again and again, or forwards and backwards."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch

from v3d_torch.datasets import RGBDSequence
from v3d_torch.types import RGBDFrame


class Replay:
    """Frames of another sequence, without its ground truth and masks.

    Time advances by the interval between the two frames in the other sequence, in either direction.

    Args:
        sequence: Sequence to take the frames from.
        indices: Indices of the frames, at least one; no two neighbours are equal.

    Attributes:
        name: Name of the other sequence.
        camera: Its camera.
        stamps: Timestamps, seconds, float64, shape :math:`(N,)`.
        groundtruth: None.
    """

    groundtruth = None

    def __init__(self, sequence: RGBDSequence, indices: Sequence[int]) -> None:
        stamps = sequence.stamps[torch.tensor(indices)]
        self.name, self.camera = sequence.name, sequence.camera
        self.stamps = torch.cat([stamps[:1], stamps[0] + stamps.diff().abs().cumsum(dim=0)])
        self._sequence = sequence
        self._indices = indices

    def __len__(self) -> int:
        return len(self._indices)

    def __iter__(self) -> Iterator[RGBDFrame]:
        return map(self.__getitem__, range(len(self)))

    def __getitem__(self, index: int) -> RGBDFrame:
        """Return a frame with its index and time in this order; all else is that of the frame."""
        index = range(len(self))[index]
        return replace(self._sequence[self._indices[index]], index=index, stamp=float(self.stamps[index]))


def again_and_again(count: int, frames: int) -> list[int]:
    """Return ``frames`` indices that run through ``count`` frames, and start again after the last one."""
    return [index % count for index in range(frames)]


def back_and_forth(count: int, frames: int) -> list[int]:
    """Return ``frames`` indices that run through ``count`` frames forwards, backwards, forwards and so on."""
    period = max(2 * (count - 1), 1)
    return [min(index % period, period - index % period) for index in range(frames)]
