"""Writer of bags of ROS 1, ROS 2 and mcap with images, for tests of the bag reader."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

Kind = Literal["bag", "db3", "mcap"]
KINDS: tuple[Kind, ...] = ("bag", "db3", "mcap")
RGB, DEPTH, INFO = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw", "/camera/color/camera_info"

Message = tuple[str, float, Any]
"""Topic, arrival time (seconds), and message made by `MessageFactory`."""


class MessageFactory:
    """Factory of the messages of one kind of bag, and writer of such bags."""

    def __init__(self, kind: Kind) -> None:
        self.kind = kind
        self.store = get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_HUMBLE)
        if kind == "bag":  # the message of transforms is missing
            definition = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(definition, "tf2_msgs/msg/TFMessage"))

    def header(self, stamp: float, frame: str) -> Any:
        nanoseconds = round(stamp * 1e9)
        time = self.store.types["builtin_interfaces/msg/Time"](nanoseconds // 10**9, nanoseconds % 10**9)
        sequence_number = (0,) if self.kind == "bag" else ()
        return self.store.types["std_msgs/msg/Header"](*sequence_number, time, frame)

    def image(
        self,
        stamp: float,
        encoding: str,
        pixels: NDArray[Any],
        *,
        pad: int = 0,
        big_endian: bool = False,
        frame: str = "optical",
    ) -> Any:
        """Make an image message from pixels (H, W) or (H, W, C), with ``pad`` bytes after each row."""
        height, width = pixels.shape[:2]
        if big_endian:
            pixels = pixels.astype(pixels.dtype.newbyteorder(">"))
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
        data = np.concatenate([rows, np.full((height, pad), 99, np.uint8)], axis=1)
        message_type = self.store.types["sensor_msgs/msg/Image"]
        return message_type(
            self.header(stamp, frame), height, width, encoding, int(big_endian), data.shape[1], data.reshape(-1)
        )

    def compressed(self, stamp: float, compression: str, content: bytes) -> Any:
        message_type = self.store.types["sensor_msgs/msg/CompressedImage"]
        return message_type(self.header(stamp, "optical"), compression, np.frombuffer(content, np.uint8))

    def info(
        self, width: int, height: int, k: list[float], d: list[float], p: list[float], model: str = "plumb_bob"
    ) -> Any:
        roi = self.store.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        arrays = [np.array(values, np.float64) for values in (d, k, np.eye(3).reshape(-1), p)]
        message_type = self.store.types["sensor_msgs/msg/CameraInfo"]
        return message_type(self.header(0, "optical"), height, width, model, *arrays, 0, 0, roi)

    def imu(self, stamp: float, acceleration: NDArray[np.float64], frame: str = "optical") -> Any:
        """Make a message of an accelerometer without gyroscope."""
        types = self.store.types
        zero = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
        unknown = np.zeros(9)
        return types["sensor_msgs/msg/Imu"](
            self.header(stamp, frame),
            types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
            unknown,
            zero,
            unknown,
            types["geometry_msgs/msg/Vector3"](*acceleration.tolist()),
            unknown,
        )

    def transform(self, parent: str, child: str, rotation: Rotation) -> Any:
        """Make a message with one transform."""
        types = self.store.types
        transform = types["geometry_msgs/msg/Transform"](
            types["geometry_msgs/msg/Vector3"](0.1, 0.2, 0.3),
            types["geometry_msgs/msg/Quaternion"](*rotation.as_quat().tolist()),
        )
        stamped = types["geometry_msgs/msg/TransformStamped"](self.header(0, parent), child, transform)
        return types["tf2_msgs/msg/TFMessage"]([stamped])

    def write(self, path: Path, messages: Iterable[Message]) -> Path:
        """Write a ``.bag`` file or the folder of a ROS 2 bag, and return its path."""
        if self.kind == "bag":
            path = path.with_suffix(".bag")
            writer: Any = Writer1(path)
            serialize: Any = self.store.serialize_ros1
        else:
            plugin = StoragePlugin.MCAP if self.kind == "mcap" else StoragePlugin.SQLITE3
            writer = Writer2(path, version=9, storage_plugin=plugin)
            serialize = self.store.serialize_cdr
        with writer:
            connections: dict[str, Any] = {}
            for topic, arrival, message in messages:
                type_name = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, type_name, typestore=self.store)
                writer.write(connections[topic], round(arrival * 1e9), bytes(serialize(message, type_name)))
        return path


def png(pixels: NDArray[Any]) -> bytes:
    """Encode pixels as PNG."""
    file = BytesIO()
    Image.fromarray(pixels).save(file, "png")
    return file.getvalue()


def compressed_depth(units: NDArray[np.uint16], a: float = 0.0, b: float = 0.0) -> bytes:
    """Encode depth as compressed_depth_image_transport does: an enumeration, two quantisation parameters, a PNG."""
    return struct.pack("<iff", 0, a, b) + png(units)
