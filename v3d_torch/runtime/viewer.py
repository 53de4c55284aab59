"""Interface of the viewers that show a run while it is processed, and the viewer that shows nothing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol

from v3d_torch.types import RGBDFrame

if TYPE_CHECKING:
    from v3d_torch.objects.frame_objects import FrameObjects
    from v3d_torch.slam import V3DSLAM


class Viewer(Protocol):
    """Viewer of a run. A viewer never changes the state of the SLAM system."""

    def show(self, frame: RGBDFrame, objects: FrameObjects, slam: V3DSLAM, stage_seconds: Mapping[str, float]) -> None:
        """Show a tracked frame.

        Args:
            frame: Images of the frame.
            objects: Objects of the frame, and its static mask.
            slam: SLAM system after it tracked the frame; its last pose is the pose of the frame.
            stage_seconds: Time that each stage spent on the frame, seconds.
        """

    def finish(self, slam: V3DSLAM) -> None:
        """Show the final map and trajectory, and close files and connections.

        Args:
            slam: SLAM system after the last frame.

        Raises:
            OutputError: If the recording cannot be written.
        """


class NullViewer:
    """Viewer that shows nothing."""

    def show(self, frame: RGBDFrame, objects: FrameObjects, slam: V3DSLAM, stage_seconds: Mapping[str, float]) -> None:
        """Do nothing."""

    def finish(self, slam: V3DSLAM) -> None:
        """Do nothing."""


NULL_VIEWER = NullViewer()
"""Viewer of a run that is not shown."""
