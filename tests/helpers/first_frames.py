"""First frames of a sequence."""

from __future__ import annotations

from collections.abc import Iterator

from v3d_torch import RGBDFrame
from v3d_torch.datasets import RGBDSequence


class FirstFrames:
    """Stream of the first frames of a sequence, without ground truth."""

    name, groundtruth = "first frames", None

    def __init__(self, sequence: RGBDSequence, count: int) -> None:
        self._sequence, self._count = sequence, count
        self.camera = sequence.camera

    def __iter__(self) -> Iterator[RGBDFrame]:
        return (self._sequence[index] for index in range(self._count))
