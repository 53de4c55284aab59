"""Bags of ROS 1 and ROS 2 and mcap files: whatever rosbags reads, without ROS."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from v3d_torch.datasets.bag_images import colour_from, depth_from
from v3d_torch.datasets.bag_topics import Topics, choose_topics
from v3d_torch.datasets.cameras import CameraChoice, camera_from_fields, choose_camera
from v3d_torch.datasets.lists import MAX_STAMP_DIFFERENCE
from v3d_torch.datasets.stored import Cursor, StoredSequence
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.io.download import Progress
from v3d_torch.io.timestamps import associate

if TYPE_CHECKING:
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

_MILLIMETRES = 1000.0
"""Units of 16-bit depth per metre, in ROS (REP 118)."""

_REPAIRS = {".bag": "rosbag reindex", ".mcap": "mcap recover", ".db3": "ros2 bag reindex", "": "ros2 bag reindex"}
"""What repairs a bag, by the suffix of the file; a folder has none."""

_LENSES = ("plumb_bob", "rational_polynomial", "")
"""Lens models that begin with k1, k2, p1, p2, k3; the second goes on."""


class BagSequence(StoredSequence):
    """Frames of a bag: colour and depth images of two topics, paired by the stamps in their headers.

    The bag is read through once for the stamps, and images are read when they are asked for.

    Args:
        path: a ``.bag``, ``.db3`` or ``.mcap`` file, or a ROS 2 bag's folder.
        camera: the user's choice; None takes the camera that the bag has for the colour images.
        rgb_topic, depth_topic, info_topic: the user's choice; None guesses (see `choose_topics`).
        progress: told of the messages as they are looked through.

    Raises:
        InputError: the bag is broken, or has no colour, depth or camera that fit together.
    """

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
        self.topics = topics = choose_topics(path, topic_types(path), rgb_topic, depth_topic, info_topic)
        own = choose_camera(camera, path, None if camera is not None else _read_camera(path, topics))
        stamps, frames = _scan(path, topics, progress)
        seen_from = [frames[topic] for topic in (topics.depth, topics.rgb)]
        if depth_topic is None and not topics.is_registered and all(seen_from) and len(set(seen_from)) > 1:
            raise InputError(
                f"{path}: depth on {topics.depth} is seen from {seen_from[0]}, colour from {seen_from[1]}; record the"
                " depth that is registered to colour (align_depth), or give --depth-topic if it is so all the same"
            )
        colour, depth = (list(stamps[topic]) for topic in (topics.rgb, topics.depth))
        pairs = associate(colour, depth, MAX_STAMP_DIFFERENCE)
        if not pairs:
            raise InputError(
                f"{path}: no image on {topics.rgb} lies within {MAX_STAMP_DIFFERENCE} s of one on {topics.depth};"
                " choose others with --rgb-topic and --depth-topic"
            )
        delays = [depth[j] - colour[i] for i, j in pairs]
        super().__init__(path.resolve().stem, [colour[i] for i, _ in pairs], own, delays=delays)
        self._pairs = [(stamps[topics.rgb][colour[i]], stamps[topics.depth][depth[j]]) for i, j in pairs]
        self._colours, self._depths = (Cursor(partial(_messages, path, topic)) for topic in (topics.rgb, topics.depth))
        self._read(0)  # what is wrong with every frame is said at once

    def _read(self, index: int) -> tuple[Tensor, Tensor]:
        i, j = self._pairs[index]
        image = colour_from(self._colours[i][-1], f"{self.path}: {self.topics.rgb}")
        depth = depth_from(self._depths[j][-1], self.camera.depth_scale, f"{self.path}: {self.topics.depth}")
        return self._check_registered(
            (f"{self.path}: {self.topics.rgb}", image),
            (f"{self.path}: {self.topics.depth}", depth),
            "name depth that is registered to colour with --depth-topic",
        )


def is_bag(path: Path) -> bool:
    """Whether a path is a file that may be a bag, or a ROS 2 bag's folder."""
    metadata = path / "metadata.yaml"
    return (path.suffix in (".bag", ".db3", ".mcap") and path.is_file()) or (
        metadata.is_file() and "rosbag2_bagfile_information" in metadata.read_text(encoding="utf-8", errors="replace")
    )


def topic_types(path: Path) -> dict[str, str]:
    """Types of a bag's topics, such as ``sensor_msgs/msg/Image`` in ROS 1 and 2.

    Raises:
        InputError: the bag cannot be read.
    """
    with _opened(path) as (reader, _):
        return {connection.topic: connection.msgtype for connection in reader.connections}


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Reader1 | Reader2, Callable[[bytes, str], Any]]]:
    """What reads a bag, and what makes messages of its bytes."""
    try:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise InputError(f"{path}: reading a bag needs rosbags ({error}); pip install rosbags") from error
    # The definitions of images and cameras are the same in all versions of ROS 1, and of ROS 2; those in the bag are
    # not needed, and one of another topic that cannot be understood does no harm.
    is_ros1 = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.LATEST)
    try:
        reader = Reader1(path) if is_ros1 else Reader2(path)
        reader.open()
    except Exception as error:
        raise _unreadable(path, error) from error
    try:
        yield reader, store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
    finally:
        reader.close()


def _unreadable(path: Path, error: Exception) -> InputError:
    # rosbags lets the errors of every format's library through.
    why = str(error).splitlines()[0] if str(error) else type(error).__name__
    return InputError(f"{path}: is no whole bag ({why}); copy it again, or repair it with {_REPAIRS[path.suffix]}")


def _messages(path: Path, *topics: str) -> Iterator[tuple[str, int, Any]]:
    """Topic, time of arrival in nanoseconds and content of every message on some topics, in order of arrival."""
    with _opened(path) as (reader, deserialize):
        connections = [connection for connection in reader.connections if connection.topic in topics]
        try:
            for connection, arrival, content in reader.messages(connections):
                yield connection.topic, arrival, deserialize(content, connection.msgtype)
        except Exception as error:
            raise _unreadable(path, error) from error


def _scan(path: Path, topics: Topics, progress: Progress | None) -> tuple[dict[str, dict[float, int]], dict[str, str]]:
    """By topic: the number of the message at each stamp, in order of time; and the frame that it is seen from."""
    stamps: dict[str, dict[float, int]] = {topics.rgb: {}, topics.depth: {}}
    frames = dict.fromkeys(stamps, "")
    counts = dict.fromkeys(stamps, 0)
    for done, (topic, arrival, message) in enumerate(_messages(path, *stamps), start=1):
        known, number = stamps[topic], counts[topic]
        counts[topic] += 1
        frames[topic] = frames[topic] or message.header.frame_id.strip("/")
        stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9 or arrival * 1e-9
        if not known or stamp > next(reversed(known)):  # a clock that was set back gives no order
            known[stamp] = number
        if progress is not None:
            progress(done, None)
    return stamps, frames


def _read_camera(path: Path, topics: Topics) -> PinholeCamera:
    """The camera of the colour images, from its first message."""
    if topics.info is None:
        raise InputError(f"{path}: has no camera beside {topics.rgb}; name it with --info-topic, or give --camera")
    info = next((message for _, _, message in _messages(path, topics.info)), None)
    if info is None:
        raise InputError(f"{path}: has nothing on {topics.info}; name another with --info-topic, or give --camera")
    # ROS 1 writes the fields' names in capitals.
    K, D, P = (getattr(info, name if hasattr(info, name) else name.lower()) for name in "KDP")
    rows = (np.asarray(P).reshape(3, 4) if topics.is_rectified else np.asarray(K).reshape(3, 3)).tolist()
    fields = {"fx": rows[0][0], "fy": rows[1][1], "cx": rows[0][2], "cy": rows[1][2]}
    lens = [] if topics.is_rectified else np.asarray(D).tolist()
    if any(lens[5:]) or (any(lens) and info.distortion_model not in _LENSES):
        raise InputError(
            f"{path}: {topics.info} has a lens of the kind {info.distortion_model}, which is not known here; record"
            " rectified images, or give --camera with k1, k2, p1, p2, k3"
        )
    size = {"width": info.width, "height": info.height, "depth_scale": _MILLIMETRES}
    return camera_from_fields(fields | size | {"distortion": (lens + [0.0] * 5)[:5]}, f"{path}: {topics.info}")
