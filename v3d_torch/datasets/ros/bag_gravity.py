"""Direction of gravity at the first frame of a bag, from the accelerometer of the camera."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from v3d_torch.datasets.gravity import gravity_direction
from v3d_torch.datasets.ros.bag_stamps import header_stamp
from v3d_torch.datasets.ros.bag_topics import shared_parts

_LOG = logging.getLogger(__name__)

IMU = "sensor_msgs/msg/Imu"
TRANSFORMS = "tf2_msgs/msg/TFMessage"

_BEFORE, _AFTER = 0.5, 0.1
"""Time before and after the first frame in which accelerations are averaged, seconds: longer than the vibration of a
hand, but short enough that the camera turns little."""

_OPTICAL_FRAME = re.compile(r"(.*?)[^_/]*_optical_frame")
"""Name of an optical frame: the camera, and one word for the sensor, as in ``camera_color_optical_frame``."""

ReadMessages = Callable[[str], Iterator[tuple[str, int, Any]]]
"""Function that yields topic, arrival time (nanoseconds) and message of a topic, in order of arrival."""


def read_gravity(
    path: object,
    types: Mapping[str, str],
    read: ReadMessages,
    colour_topic: str,
    colour_frame: str,
    first_stamp: float,
) -> Tensor | None:
    """Read the direction of gravity; of several accelerometers, that of the camera is preferred.

    Args:
        path: Path of the bag, for the log.
        types: Message type of each topic.
        read: Function that reads the messages of a topic.
        colour_topic: Topic of the colour images; topics of one camera share the first parts of their names.
        colour_frame: Name of the frame of the colour camera, without slashes.
        first_stamp: Stamp of the first frame, seconds.

    Returns:
        Unit vector, frame of the colour camera, float64, shape :math:`(3,)`. None if no accelerometer measured around
        the first frame, or if its orientation relative to the camera is not known.
    """
    topics = [topic for topic, kind in types.items() if kind == IMU]
    for topic in sorted(topics, key=lambda topic: -shared_parts(topic, colour_topic)):
        frame, accelerations = _read_accelerations(read(topic), first_stamp)
        if not np.any(accelerations):  # such as on the topic of a gyroscope
            continue
        transforms = [name for name, kind in types.items() if kind == TRANSFORMS and name.endswith("tf_static")]
        rotation = _find_rotation(colour_frame, frame, [message for name in transforms for *_, message in read(name)])
        if rotation is not None:
            return gravity_direction(accelerations @ rotation.T, f"{path}: {topic}")
        _LOG.warning(
            "%s: the orientation of %s on %s relative to %s is not in /tf_static; gravity is not used",
            path, frame or "a frame without name", topic, colour_frame or "a frame without name",
        )  # fmt: skip
    return None


def _read_accelerations(
    messages: Iterator[tuple[str, int, Any]], first_stamp: float
) -> tuple[str, NDArray[np.float64]]:
    """Read the frame and the accelerations, shape (N, 3), around the first image."""
    frame, accelerations = "", [np.zeros((0, 3))]
    for _, _, message in messages:
        since = header_stamp(message) - first_stamp
        if since > _AFTER:
            break
        if since >= -_BEFORE:
            frame, measured = message.header.frame_id.strip("/"), message.linear_acceleration
            accelerations.append(np.array([[measured.x, measured.y, measured.z]]))
    return frame, np.concatenate(accelerations)


def _find_rotation(target: str, source: str, messages: list[Any]) -> NDArray[np.float64] | None:
    """Rotation from frame ``source`` to ``target`` by static transforms, shape (3, 3); None if they are not connected.

    The optical frames of a camera have the same axes, even if no transform connects them. Frames without names are not
    known to be the same.
    """
    if not target or not source:
        return None
    optical = [_OPTICAL_FRAME.fullmatch(name) for name in (target, source)]
    is_same_camera = optical[0] is not None and optical[1] is not None and optical[0][1] == optical[1][1]
    if target == source or (is_same_camera and not messages):
        return np.eye(3)
    neighbours: dict[str, list[tuple[str, Rotation]]] = {}
    for transform in (transform for message in messages for transform in message.transforms):
        parent, child = transform.header.frame_id.strip("/"), transform.child_frame_id.strip("/")
        q = transform.transform.rotation
        quaternion = np.array([q.x, q.y, q.z, q.w])
        if not 0 < np.linalg.norm(quaternion) < np.inf:
            continue  # a publisher without a calibration leaves the rotation unset
        rotation = Rotation.from_quat(quaternion)  # child to parent
        neighbours.setdefault(child, []).append((parent, rotation))
        neighbours.setdefault(parent, []).append((child, rotation.inv()))
    known, pending = {source: Rotation.identity()}, [source]
    while pending:
        frame = pending.pop()
        for other, rotation in neighbours.get(frame, []):
            if other not in known:
                known[other] = rotation * known[frame]
                pending.append(other)
    return known[target].as_matrix() if target in known else None
