"""Viewer that writes the ROS 2 messages of a run to a bag."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from v3d_torch.errors import OutputError
from v3d_torch.export.ros.bag_file import BagFile
from v3d_torch.export.ros.messages import nanoseconds
from v3d_torch.export.ros.run_messages import RunMessages, TopicMessage
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.io.files import check_writable
from v3d_torch.objects.frame_objects import FrameObjects
from v3d_torch.reconstruction.point_map import PointMap
from v3d_torch.runtime.stage_timer import StageTime
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import RGBDFrame


class BagViewer:
    """Viewer that writes the messages of `RunMessages` to a bag; the first frame creates the bag.

    If a message cannot be written, the run continues without the bag, and `finish` raises the error.

    Args:
        path: File to write, ``.mcap``; it must not exist.
        camera: Camera of all frames.

    Raises:
        OutputError: If the file exists, has another suffix or cannot be written.
    """

    def __init__(self, path: Path, camera: PinholeCamera) -> None:
        if path.suffix != ".mcap":
            raise OutputError(f"{path}: is not the name of an MCAP file; choose a name that ends in .mcap")
        if path.exists():
            raise OutputError(f"{path}: already exists; delete it, or choose another file for the bag")
        check_writable(path)
        self._path = path
        self._messages = RunMessages(camera)
        self._bag: BagFile | None = None
        self._error: OutputError | None = None

    def show(
        self, frame: RGBDFrame, objects: FrameObjects, slam: V3DSLAM, stage_times: Mapping[str, StageTime]
    ) -> None:
        """Write the messages of a frame. The time this takes is recorded as the stage ``viewer``."""
        with slam.timer("viewer"):
            self._write(self._messages.of_frame(frame, objects, slam))

    def finish(self, slam: V3DSLAM, point_map: PointMap) -> None:
        """Write the final path and map, if the camera was ever found, and close the file.

        Raises:
            OutputError: If the bag could not be written completely.
        """
        if self._bag is not None:
            self._write(self._messages.of_end(slam, point_map))
            try:
                self._bag.close()
            except OutputError as error:
                self._error = self._error or error
        if self._error is not None:
            raise self._error

    def _write(self, messages: Iterable[TopicMessage]) -> None:
        """Write messages at the times of their headers: players do not apply transforms that are later."""
        if self._error is not None:
            return
        try:
            self._bag = self._bag or BagFile(self._path)
            for topic, message in messages:
                self._bag.write(topic, message, nanoseconds(self._messages.stamp))
        except OutputError as error:
            self._error = error
