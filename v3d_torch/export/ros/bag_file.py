"""File of ROS 2 messages in the MCAP format, which ROS 2, Foxglove and rosbags read without further files."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path
from typing import BinaryIO

from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore

from v3d_torch.errors import OutputError
from v3d_torch.export.ros.run_messages import Message

_TRANSIENT_LOCAL = """\
- history: 3
  depth: 0
  reliability: 1
  durability: 1
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 9223372036
    nsec: 854775807
  liveliness: 1
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false"""
"""Quality of service of a publisher whose last message new subscribers receive, as the recorder of ROS 2 Humble writes
it: ``ros2 bag play`` publishes with the recorded one."""

_QUALITY_OF_SERVICE = {"/map": _TRANSIENT_LOCAL}
"""Quality of service of topics whose subscribers expect another one than the default, here those of nav2."""


class BagFile:
    """Writer of a bag.

    Messages are written in blocks of a megabyte; ``mcap recover`` repairs a file that was not closed.

    Args:
        path: File to write; it must not exist.

    Raises:
        OutputError: If the file exists or cannot be written. Every method can raise it.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file: BinaryIO = path.open("xb")
            self._writer = Writer(self._file)
            self._writer.start("ros2", f"v3d-torch {version('v3d-torch')}")
            # Later distributions read numbers as qualities of service only in files with this record of the recorder.
            self._writer.add_metadata("rosbag2", {"ROS_DISTRO": "humble"})
        except OSError as error:
            raise self._error(error) from error
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def write(self, topic: str, message: Message, time: int) -> None:
        """Add a message.

        Args:
            topic: Topic; all its messages have the same type.
            message: Message.
            time: Time of the message, nanoseconds.
        """
        try:
            content = bytes(self._store.serialize_cdr(message, message.__msgtype__))
            self._writer.add_message(self._channel(topic, message.__msgtype__), time, content, time)
        except OSError as error:
            raise self._error(error) from error

    def close(self) -> None:
        """Write the index and close the file."""
        try:
            with self._file:
                self._writer.finish()
        except OSError as error:
            raise self._error(error) from error

    def _channel(self, topic: str, kind: str) -> int:
        """Return the channel of a topic; the first message of a topic or type adds the channel or the definition."""
        if kind not in self._schemas:
            definition, _ = self._store.generate_msgdef(kind, ros_version=2)
            self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", definition.encode())
        if topic not in self._channels:
            quality = {"offered_qos_profiles": _QUALITY_OF_SERVICE.get(topic, "")}
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[kind], quality)
        return self._channels[topic]

    def _error(self, error: OSError) -> OutputError:
        reason = error.strerror or str(error)
        return OutputError(f"{self._path}: the bag cannot be written ({reason}); free the disk or choose another file")
