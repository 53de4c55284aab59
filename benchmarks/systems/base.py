"""Interface of a system."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from v3d_torch.types import Trajectory


class System(Protocol):
    """System that is ready to run: everything that is loaded once per process is loaded."""

    @property
    def stages(self) -> Mapping[str, float]:
        """Seconds by stage; empty if the system does not measure them."""

    def __call__(self) -> None:
        """Read and track all frames of the sequence. This call is timed."""

    def trajectory(self) -> Trajectory:
        """Return the poses after the last frame; lost frames may be missing."""
