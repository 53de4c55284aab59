"""Messages of a bag, read by the MCAP library and its ROS 2 decoder, or by rosbags."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from numpy.typing import NDArray
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

Messages = dict[str, list[tuple[int, Any]]]
"""Time (nanoseconds) and message, in the order of the file, by topic."""


def read_with_mcap(path: Path) -> Messages:
    """Read a file; the decoder uses the definitions in the file only."""
    messages: Messages = defaultdict(list)
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            messages[channel.topic].append((message.log_time, decoded))
    return messages


def read_with_rosbags(path: Path) -> Messages:
    """Read a file; the decoder uses the definitions of the newest ROS 2."""
    store = get_typestore(Stores.LATEST)
    messages: Messages = defaultdict(list)
    with Reader(path) as reader:
        for connection, time, content in reader.messages():
            messages[connection.topic].append((time, store.deserialize_cdr(content, connection.msgtype)))
    return messages


def stamp_of(header: Any) -> float:
    return header.stamp.sec + header.stamp.nanosec * 1e-9


def matrix_of(pose: Any) -> NDArray[np.float64]:
    """Return the matrix of a pose or transform message, shape (4, 4)."""
    position = pose.position if hasattr(pose, "position") else pose.translation
    rotation = pose.orientation if hasattr(pose, "orientation") else pose.rotation
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([rotation.x, rotation.y, rotation.z, rotation.w]).as_matrix()
    T[:3, 3] = position.x, position.y, position.z
    return T


def lookup(message: Any, parent: str, child: str) -> NDArray[np.float64]:
    """Return the transform from a child to an ancestor, as tf2 does: the product along the tree, shape (4, 4)."""
    parents = {each.child_frame_id: each for each in message.transforms}
    T = np.eye(4)
    while child != parent:
        T, child = matrix_of(parents[child].transform) @ T, parents[child].header.frame_id
    return T


def points_of(cloud: Any) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return points and RGB of a cloud, shape (N, 3) each, by the layout that the message states."""
    offsets = {field.name: field.offset for field in cloud.fields}
    assert all(field.datatype == 7 and field.count == 1 for field in cloud.fields) and not cloud.is_bigendian
    rows = np.frombuffer(bytes(cloud.data), np.uint8).reshape(cloud.height * cloud.width, cloud.point_step)
    assert cloud.row_step == cloud.width * cloud.point_step
    xyz = [np.ascontiguousarray(rows[:, offsets[name] : offsets[name] + 4]).view("<f4")[:, 0] for name in "xyz"]
    blue_green_red = rows[:, offsets["rgb"] : offsets["rgb"] + 3]
    return np.stack(xyz, axis=1), blue_green_red[:, ::-1]
