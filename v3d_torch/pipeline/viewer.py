"""Viewers of a run, which show each frame and the final map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from v3d_torch.errors import OutputError
from v3d_torch.objects.frame_objects import FrameObjects
from v3d_torch.reconstruction.point_map import PointMap
from v3d_torch.runtime.stage_timer import StageTime
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import RGBDFrame


class Viewer(Protocol):
    """Viewer of a run. A viewer never changes the state of the SLAM system."""

    def show(
        self, frame: RGBDFrame, objects: FrameObjects, slam: V3DSLAM, stage_times: Mapping[str, StageTime]
    ) -> None:
        """Show a tracked frame.

        Args:
            frame: Images of the frame.
            objects: Objects of the frame, and its static mask.
            slam: SLAM system after it tracked the frame; its last pose is the pose of the frame.
            stage_times: Time that each stage spent on the frame.
        """

    def finish(self, slam: V3DSLAM, point_map: PointMap) -> None:
        """Show the final map and trajectory, and close files and connections.

        Args:
            slam: SLAM system after the last frame.
            point_map: Point map of the static scene.

        Raises:
            OutputError: If the recording cannot be written.
        """


class ViewerGroup:
    """Several viewers of one run, or none.

    Args:
        viewers: Viewers; empty to show nothing.
    """

    def __init__(self, viewers: Sequence[Viewer]) -> None:
        self._viewers = viewers

    def show(
        self, frame: RGBDFrame, objects: FrameObjects, slam: V3DSLAM, stage_times: Mapping[str, StageTime]
    ) -> None:
        """Show a tracked frame in all viewers."""
        for viewer in self._viewers:
            viewer.show(frame, objects, slam, stage_times)

    def finish(self, slam: V3DSLAM, point_map: PointMap) -> None:
        """Finish all viewers, even if one of them fails.

        Raises:
            OutputError: The errors of all viewers, in one line.
        """
        errors = []
        for viewer in self._viewers:
            try:
                viewer.finish(slam, point_map)
            except OutputError as error:
                errors.append(str(error))
        if errors:
            raise OutputError("; ".join(errors))
