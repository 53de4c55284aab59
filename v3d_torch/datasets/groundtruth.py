"""Ground truth of a stored sequence, and the number of its poses that were not measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from v3d_torch.types import Trajectory


@dataclass(frozen=True)
class GroundTruth:
    """Ground truth of a stored sequence.

    Attributes:
        trajectory: Measured poses of the camera; empty if no pose was measured.
        missing: Number of poses that were left out because they are empty or not finite, which marks lost tracking.
    """

    trajectory: Trajectory
    missing: int = 0

    @property
    def note(self) -> str | None:
        """Sentence on the poses that were left out; None if there are none."""
        if not self.missing:
            return None
        total = self.missing + len(self.trajectory)
        return f"{self.missing} of {total} poses of the ground truth are empty or not finite and are left out"

    def convert(self, to_camera: Callable[[Trajectory], Trajectory]) -> GroundTruth:
        """Return the ground truth with converted poses.

        Args:
            to_camera: Function that converts the poses of the data set to poses of the camera.
        """
        return replace(self, trajectory=to_camera(self.trajectory))


ReadGroundTruth = Callable[[], GroundTruth | None]
"""Function that reads the ground truth; it returns None if the sequence has none."""
