"""Frames of a sequence in an order of choice: its beginning, or forth and back for as long as one likes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from v3d_torch.camera import PinholeCamera
from v3d_torch.datasets import RGBDSequence
from v3d_torch.types import RGBDFrame


class Replay:
    """An `RGBDSequence` of frames of another, without its ground truth and masks.

    Time goes on by as much as lies between two frames in the other, in whichever direction.

    Args:
        sequence: that has the frames.
        indices: of the frames, no two neighbours equal, at least one.
    """

    groundtruth = None

    def __init__(self, sequence: RGBDSequence, indices: Sequence[int]) -> None:
        self.name = sequence.name
        self.camera: PinholeCamera = sequence.camera
        self._sequence = sequence
        self._indices = indices
        stamps = sequence.stamps[torch.tensor(indices)]
        self.stamps: Tensor = torch.cat([stamps[:1], stamps[0] + stamps.diff().abs().cumsum(dim=0)])

    def __len__(self) -> int:
        return len(self._indices)

    def __iter__(self) -> Iterator[RGBDFrame]:
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int) -> RGBDFrame:
        """Frame ``index`` of the replay, which raises IndexError behind the last."""
        return replace(self._sequence[self._indices[index]], index=index, stamp=float(self.stamps[index]))


def forth_and_back(count: int, frames: int) -> list[int]:
    """Indices that go through ``count`` frames forth, back, and so on, until there are ``frames`` of them."""
    period = max(2 * (count - 1), 1)
    return [min(index % period, period - index % period) for index in range(frames)]
