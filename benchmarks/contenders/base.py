"""What every contender offers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from v3d_torch.types import Trajectory


class Contender(Protocol):
    """A system that is ready to run: all that a user would load once, however many frames follow, is loaded."""

    @property
    def stages(self) -> Mapping[str, float]:
        """Seconds by stage, where the system tells them."""

    def __call__(self) -> None:
        """Read and take in all frames of the sequence, until the last has a pose. This is what is timed."""

    def trajectory(self) -> Trajectory:
        """The poses it found, as they are after the last frame; frames that it lost may be left out."""
