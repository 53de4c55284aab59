"""RGB-D sequences in ROS 1 bags, ROS 2 bags and mcap files, read with rosbags and without ROS."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.datasets.broken_frames import first_readable
from v3d_torch.datasets.cameras import CameraChoice, camera_file, choose_camera
from v3d_torch.datasets.cursor import Cursor
from v3d_torch.datasets.image_sequence import ImageSequence
from v3d_torch.datasets.lists import MAX_STAMP_DIFFERENCE, note_unpaired
from v3d_torch.datasets.ros.bag_gravity import TRANSFORMS, read_gravity
from v3d_torch.datasets.ros.bag_images import decode_colour_message, decode_depth_message
from v3d_torch.datasets.ros.bag_stamps import header_stamp, index_by_stamp
from v3d_torch.datasets.ros.bag_topics import BagTopics, choose_topics
from v3d_torch.datasets.ros.camera_info import camera_from_info, fields_of_info
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.depth_scale import MILLIMETRES
from v3d_torch.io.download import Progress
from v3d_torch.io.names import path_label
from v3d_torch.io.text import first_line
from v3d_torch.io.timestamps import associate

if TYPE_CHECKING:
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

_REPAIR_COMMANDS = {".bag": "rosbag reindex", ".mcap": "mcap recover", ".db3": "ros2 bag reindex"}
"""Command that repairs a file, by its suffix."""


class BagSequence(ImageSequence):
    """RGB-D frames of a bag: colour and depth images of two topics, paired by their header stamps.

    The constructor reads the bag once for the stamps; images are decoded when a frame is requested.

    Args:
        path: A ``.bag``, ``.db3`` or ``.mcap`` file, or the folder of a ROS 2 bag.
        camera: Camera chosen by the user; None for the ``camera.yaml`` or ``K.txt`` in the folder of a ROS 2 bag, else
            the CameraInfo of the colour images.
        rgb_topic: Topic of the colour images; None to choose it by name, see `choose_topics`.
        depth_topic: Topic of the depth images; None to choose it by name.
        info_topic: Topic of the camera info; None to choose it by name.
        progress: Called with the number of messages read so far.

    Raises:
        InputError: If the bag is damaged, has no matching colour, depth and camera, or has a clock that was set back.
    """

    registration_fix = "choose depth registered to colour with --depth-topic"

    def __init__(
        self,
        path: Path,
        camera: CameraChoice = None,
        *,
        rgb_topic: str | None = None,
        depth_topic: str | None = None,
        info_topic: str | None = None,
        progress: Progress | None = None,
    ) -> None:
        self.path = path
        types = read_topic_types(path)
        self.topics = topics = choose_topics(path, types, rgb_topic, depth_topic, info_topic)
        chosen = choose_camera(
            camera,
            path,
            lambda: _read_camera(path, topics),
            depth_scale=MILLIMETRES,
            image_size=lambda: _image_size(path, topics),
        )
        is_recorded = camera is None and camera_file(path) is None  # the camera is that of the CameraInfo
        stamps, frame_ids, self._index_notes = _index_messages(path, topics, progress, with_info=is_recorded)
        depth_frame, colour_frame = frame_ids[topics.depth], frame_ids[topics.rgb]
        is_confirmed = depth_topic is not None or topics.is_registered
        if not is_confirmed and depth_frame and colour_frame and depth_frame != colour_frame:
            raise InputError(
                f"{path}: depth on {topics.depth} is in frame {depth_frame}, colour in frame {colour_frame}; record"
                " depth that is registered to colour (align_depth), or pass --depth-topic if this depth is registered"
            )
        colour_stamps, depth_stamps = (list(stamps[topic]) for topic in (topics.rgb, topics.depth))
        pairs = associate(colour_stamps, depth_stamps, MAX_STAMP_DIFFERENCE)
        if not pairs:
            raise InputError(
                f"{path}: no image on {topics.rgb} is within {MAX_STAMP_DIFFERENCE} s of an image on {topics.depth};"
                " choose other topics with --rgb-topic and --depth-topic"
            )
        super().__init__(
            path_label(path),
            [colour_stamps[i] for i, _ in pairs],
            chosen,
            delays=[depth_stamps[j] - colour_stamps[i] for i, j in pairs],
        )
        # Never an error: the stamps are those of one recording, in which messages of both topics can be lost.
        self.pairing_note = note_unpaired(colour_stamps, pairs)
        self._message_indices = [
            (stamps[topics.rgb][colour_stamps[i]], stamps[topics.depth][depth_stamps[j]]) for i, j in pairs
        ]
        self._colour_messages, self._depth_messages = (
            Cursor(partial(_read_messages, path, topic)) for topic in (topics.rgb, topics.depth)
        )
        first_readable(self._read, range(len(self)))  # raise errors that concern every frame here, and not later
        read, start = partial(_read_messages, path), float(self.stamps[0])
        self.gravity = read_gravity(path, types, read, topics.rgb, colour_frame, start)

    @property
    def notes(self) -> list[str]:
        """Sentences about the sequence that a user needs to know, also on images left out and a camera that changes."""
        return [*super().notes, *self._index_notes]

    def _sources(self, index: int) -> tuple[str, str]:
        return f"{self.path}: {self.topics.rgb}", f"{self.path}: {self.topics.depth}"

    def _read_colour(self, index: int) -> Tensor:
        message = self._colour_messages[self._message_indices[index][0]][-1]
        return decode_colour_message(message, self._sources(index)[0])

    def _read_depth(self, index: int) -> NDArray[np.generic]:
        message = self._depth_messages[self._message_indices[index][1]][-1]
        return decode_depth_message(message, self._sources(index)[1])


def is_bag(path: Path) -> bool:
    """Check whether a path is a file with the suffix of a bag, or the folder of a ROS 2 bag."""
    metadata = path / "metadata.yaml"
    return (path.suffix in (".bag", ".db3", ".mcap") and path.is_file()) or (
        metadata.is_file() and "rosbag2_bagfile_information" in metadata.read_text(encoding="utf-8", errors="replace")
    )


def read_topic_types(path: Path) -> dict[str, str]:
    """Read the message type of each topic of a bag, such as ``sensor_msgs/msg/Image`` in ROS 1 and 2.

    Raises:
        InputError: If the bag cannot be read.
    """
    with _open_bag(path) as (reader, _):
        return {connection.topic: connection.msgtype for connection in reader.connections}


@contextmanager
def _open_bag(path: Path) -> Iterator[tuple[Reader1 | Reader2, Callable[[bytes, str], Any]]]:
    """Open a bag; yield its reader and the function that deserializes a message of a given type."""
    try:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise InputError(f"{path}: reading a bag needs rosbags ({error}); run pip install rosbags") from error
    # The definitions of images and cameras are the same in all versions of ROS 1, and in all of ROS 2. The definitions
    # in the bag are not parsed, so that a malformed definition of an unrelated topic causes no error.
    is_ros1 = path.suffix == ".bag" and path.is_file()  # the folder of a ROS 2 bag can have any name
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.LATEST)
    if is_ros1:  # rosbags lacks the message of transforms
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORMS))
    try:
        reader = Reader1(path) if is_ros1 else Reader2(path)
        reader.open()
    except Exception as error:
        raise _damaged_bag_error(path, error) from error
    try:
        yield reader, store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
    finally:
        reader.close()


def _damaged_bag_error(path: Path, error: Exception) -> InputError:
    # rosbags does not wrap the errors of the libraries that it uses for each format.
    repair = _REPAIR_COMMANDS[path.suffix] if path.is_file() else "ros2 bag reindex"
    return InputError(
        f"{path}: is damaged or not a bag ({first_line(error)}); copy it again, or repair it with {repair}"
    )


def _read_messages(path: Path, *topics: str) -> Iterator[tuple[str, int, Any]]:
    """Yield topic, arrival time (nanoseconds) and message of some topics, in order of arrival."""
    with _open_bag(path) as (reader, deserialize):
        connections = [connection for connection in reader.connections if connection.topic in topics]
        try:
            for connection, arrival, content in reader.messages(connections):
                yield connection.topic, arrival, deserialize(content, connection.msgtype)
        except Exception as error:
            raise _damaged_bag_error(path, error) from error


def _index_messages(
    path: Path, topics: BagTopics, progress: Progress | None, *, with_info: bool
) -> tuple[dict[str, dict[float, int]], dict[str, str], list[str]]:
    """Index the colour and depth messages of a bag, and compare its CameraInfo messages.

    Args:
        path: Path of the bag.
        topics: Topics.
        progress: Called with the number of messages read so far.
        with_info: True to compare the CameraInfo messages.

    Returns:
        For each topic, the message index by stamp (seconds, increasing); for each topic, its frame_id; and sentences on
        images that were dropped, see `index_by_stamp`, and on a camera that changes.
    """
    stamps: dict[str, list[float]] = {topics.rgb: [], topics.depth: []}
    arrivals: dict[str, list[float]] = {topic: [] for topic in stamps}
    frame_ids = dict.fromkeys(stamps, "")
    info = topics.info if with_info else None
    read = [*stamps] if info is None else [*stamps, info]
    cameras: list[tuple[float, dict[str, Any]]] = []  # the first one, and the first different one
    for done, (topic, arrival, message) in enumerate(_read_messages(path, *read), start=1):
        if topic == info:
            if len(cameras) < 2:
                fields = fields_of_info(message, is_rectified=topics.is_rectified)
                if fields not in [known for _, known in cameras]:
                    cameras.append((arrival * 1e-9, fields))
            continue
        stamps[topic].append(header_stamp(message))
        arrivals[topic].append(arrival * 1e-9)
        frame_ids[topic] = frame_ids[topic] or message.header.frame_id.strip("/")
        if progress is not None:
            progress(done, None)
    indexed = {topic: index_by_stamp(path, topic, stamps[topic], arrivals[topic]) for topic in stamps}
    notes = [note for _, note in indexed.values() if note is not None]
    if len(cameras) > 1:
        notes.append(_note_camera_change(path, topics, cameras[1][0]))
    return {topic: indices for topic, (indices, _) in indexed.items()}, frame_ids, notes


def _read_camera(path: Path, topics: BagTopics) -> PinholeCamera:
    """Read the colour camera from the first CameraInfo message."""
    if topics.info is None:
        raise InputError(
            f"{path}: has no CameraInfo topic for {topics.rgb}; name it with --info-topic, or pass --camera"
        )
    info = next((message for _, _, message in _read_messages(path, topics.info)), None)
    if info is None:
        raise InputError(
            f"{path}: has no messages on {topics.info}; name another topic with --info-topic, or pass --camera"
        )
    return camera_from_info(info, f"{path}: {topics.info}", is_rectified=topics.is_rectified)


def _note_camera_change(path: Path, topics: BagTopics, arrival: float) -> str:
    """Return a sentence on a camera that changes with the CameraInfo that arrived at this time, seconds."""
    return (
        f"{path}: {topics.info}: the camera changes at {arrival:.6f} s (time of arrival), but all frames use the first"
        " one; cut the bag there, or pass --camera if the change is wrong"
    )


def _image_size(path: Path, topics: BagTopics) -> tuple[int, int]:
    """Width and height of the first depth image."""
    message = next((message for _, _, message in _read_messages(path, topics.depth)), None)
    if message is None:
        raise InputError(f"{path}: has no messages on {topics.depth}; choose another topic with --depth-topic")
    height, width = decode_depth_message(message, f"{path}: {topics.depth}").shape
    return width, height
