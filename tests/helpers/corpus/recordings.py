"""Bags of ROS 1, ROS 2 and mcap."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from pathlib import Path

import numpy as np

from helpers.bags import DEPTH, INFO, RGB, Kind, Message, Messages
from helpers.corpus.base import FOCAL, FRAMES, HEIGHT, NOISE, WIDTH, colour, depth, way
from helpers.corpus.case import Case, Make, Place, Right, Says, all_of, half, options, seq

K = [FOCAL, 0, (WIDTH - 1) / 2, 0, FOCAL, (HEIGHT - 1) / 2, 0, 0, 1]
P = [*K[:3], 0, *K[3:6], 0, *K[6:], 0]
MILLIMETRES = (depth() // 5).astype(np.uint16)

Change = Callable[[Messages, list[Message]], list[Message]]


def bag(kind: Kind, change: Change | None = None) -> Make:
    """The sequence as a bag, its messages changed; of a ROS 2 bag the file, beside which its metadata stay."""

    def make(place: Place) -> None:
        to = Messages(kind)
        messages: list[Message] = [(INFO, 10.0, to.info(WIDTH, HEIGHT, K, [], P))]
        for i in range(FRAMES):
            stamp = 10 + i / 10
            messages.append((RGB, stamp, to.image(stamp, "bgr8", colour(*way(i)))))
            messages.append((DEPTH, stamp, to.image(stamp, "16UC1", MILLIMETRES)))
        path = to.write(place.root / "take", change(to, messages) if change is not None else messages)
        place.seq = str(path if kind == "bag" else next(path.glob(f"*.{kind}")))

    return make


def without(topic: str) -> Change:
    return lambda to, messages: [message for message in messages if message[0] != topic]


def with_all(topic: str, content: Callable[[Messages, float], object]) -> Change:
    """Other messages on a topic."""

    def change(to: Messages, messages: list[Message]) -> list[Message]:
        return [(name, at, content(to, at) if name == topic else message) for name, at, message in messages]

    return change


def camera(k: list[float], d: tuple[float, ...] = (), model: str = "plumb_bob") -> Change:
    return with_all(INFO, lambda to, at: to.info(WIDTH, HEIGHT, k, list(d), P, model))


def too_high(to: Messages, at: float) -> object:
    message = to.image(at, "bgr8", colour(0))
    message.height = 10**6
    return message


def without_size(to: Messages, at: float) -> object:
    message = to.image(at, "bgr8", colour(0))
    message.height = message.width = message.step = 0
    message.data = np.zeros(0, np.uint8)
    return message


def with_holes(to: Messages, at: float) -> object:
    metres = (depth() / 5000).astype(np.float32)
    metres[:, ::8] = np.nan
    return to.image(at, "32FC1", metres)


def cut(change: Callable[[bytes], bytes]) -> Make:
    """Change the bytes of the bag."""

    def make(place: Place) -> None:
        path = Path(place.seq)
        path.write_bytes(change(path.read_bytes()))

    return make


def noise(name: str) -> Make:
    """A file of noise under a name, given as the sequence."""
    return all_of(lambda place: (place.root / name).write_bytes(NOISE), seq("{root}/" + name))


def other_database(place: Place) -> None:
    with sqlite3.connect(place.root / "notes.db3") as database:
        database.execute("CREATE TABLE notes (text TEXT)")
    database.close()


def without_metadata(place: Place) -> None:
    (place.root / "take" / "metadata.yaml").write_text("rosbag2_bagfile_information: [")


CASES = [
    Case("bag of ROS 1", bag("bag"), Right(ate=None)),
    Case("bag of ROS 2", bag("db3"), Right(ate=None)),
    Case("mcap", bag("mcap"), Right(ate=None)),
    Case(
        "ROS 1 breaks off",
        all_of(bag("bag"), cut(half)),
        Says("{root}/take.bag: is damaged or not a bag (...); copy it again, or repair it with rosbag reindex"),
    ),
    Case(
        "ROS 2 breaks off",
        all_of(bag("db3"), cut(half)),
        Says("{root}/take/take.db3: is damaged or not a bag (...); copy it again, or repair it with ros2 bag reindex"),
    ),
    Case(
        "mcap breaks off",
        all_of(bag("mcap"), cut(half)),
        Says("{root}/take/take.mcap: is damaged or not a bag (...); copy it again, or repair it with mcap recover"),
    ),
    Case(
        "ROS 1 is empty",
        all_of(bag("bag"), cut(lambda content: b"")),
        Says("{root}/take.bag: is damaged or not a bag (...); copy it again, or repair it with rosbag reindex"),
    ),
    Case(
        "ROS 2 is empty",
        all_of(bag("db3"), cut(lambda content: b"")),
        Says("{root}/take/take.db3: is damaged or not a bag (...); copy it again, or repair it with ros2 bag reindex"),
    ),
    Case(
        "mcap is empty",
        all_of(bag("mcap"), cut(lambda content: b"")),
        Says("{root}/take/take.mcap: is damaged or not a bag (...); copy it again, or repair it with mcap recover"),
    ),
    Case(
        "ROS 1 is noise",
        noise("take.bag"),
        Says("{root}/take.bag: is damaged or not a bag (...); copy it again, or repair it with rosbag reindex"),
    ),
    Case(
        "ROS 2 is noise",
        noise("take.db3"),
        Says("{root}/take.db3: is damaged or not a bag (...); copy it again, or repair it with ros2 bag reindex"),
    ),
    Case(
        "mcap is noise",
        noise("take.mcap"),
        Says("{root}/take.mcap: is damaged or not a bag (...); copy it again, or repair it with mcap recover"),
    ),
    Case(
        "another database",
        all_of(other_database, seq("{root}/notes.db3")),
        Says("{root}/notes.db3: is damaged or not a bag (...); copy it again, or repair it with ros2 bag reindex"),
    ),
    Case(
        "a ROS 2 folder whose metadata are broken",
        all_of(bag("db3"), without_metadata, seq("{root}/take")),
        Says("{root}/take: is damaged or not a bag (...); copy it again, or repair it with ros2 bag reindex"),
    ),
    Case(
        "no camera",
        bag("mcap", without(INFO)),
        Says(
            "{root}/take/take.mcap: has no CameraInfo topic for /camera/color/image_raw; name it"
            " with --info-topic, or give --camera"
        ),
    ),
    Case(
        "no depth",
        bag("bag", without(DEPTH)),
        Says(
            "{root}/take.bag: no topic is named like depth images; set --depth-topic to one of /camera/color/image_raw"
        ),
    ),
    Case(
        "no colour",
        bag("mcap", without(RGB)),
        Says(
            "{root}/take/take.mcap: no topic is named like colour images; set --rgb-topic to one of"
            " /camera/aligned_depth_to_color/image_raw"
        ),
    ),
    Case(
        "no images",
        bag("bag", lambda to, messages: messages[:1]),
        Says("{root}/take.bag: contains no images; record the colour, depth and CameraInfo topics"),
    ),
    Case(
        "two clocks",
        bag("db3", with_all(DEPTH, lambda to, at: to.image(at + 100, "16UC1", MILLIMETRES))),
        Says(
            "{root}/take/take.db3: no image on /camera/color/image_raw is within 0.02 s of an image on"
            " /camera/aligned_depth_to_color/image_raw; choose other topics with --rgb-topic and --depth-topic"
        ),
    ),
    Case(
        "depth of 8 bits",
        bag("mcap", with_all(DEPTH, lambda to, at: to.image(at, "mono8", colour(0)[..., 0]))),
        Says(
            "{root}/take/take.mcap: /camera/aligned_depth_to_color/image_raw: holds mono8 images, not"
            " depth; choose another topic with --depth-topic"
        ),
    ),
    Case(
        "depth for colour",
        bag("mcap", with_all(RGB, lambda to, at: to.image(at, "16UC1", MILLIMETRES))),
        Says(
            "{root}/take/take.mcap: /camera/color/image_raw: holds 16UC1 images, not colour; choose another"
            " topic with --rgb-topic, or convert the images to one of rgb8, 8UC3, bgr8, rgba8, bgra8, mono8, y8,"
            " 8UC1, bayer_rggb8, bayer_bggr8, bayer_gbrg8, bayer_grbg8, yuv422, uyvy, yuv422_yuy2, yuyv"
        ),
    ),
    Case(
        "depth of another size",
        bag("mcap", with_all(DEPTH, lambda to, at: to.image(at, "16UC1", MILLIMETRES[::2]))),
        Says(
            "{root}/take/take.mcap: /camera/aligned_depth_to_color/image_raw: has 80x30 pixels, its colour"
            " image 80x60; choose depth registered to colour with --depth-topic"
        ),
    ),
    Case("depth with NaN", bag("mcap", with_all(DEPTH, with_holes)), Right(ate=None)),
    Case(
        "images shorter than they say",
        bag("mcap", with_all(RGB, too_high)),
        Says(
            "{root}/take/take.mcap: /camera/color/image_raw: an image has less data than its 80x1000000"
            " pixels need; record the bag again"
        ),
    ),
    Case(
        "images without pixels",
        bag("mcap", with_all(RGB, without_size)),
        Says("{root}/take/take.mcap: /camera/color/image_raw: an image has no pixels; record the bag again"),
    ),
    Case(
        "an unknown encoding",
        bag("mcap", with_all(RGB, lambda to, at: to.image(at, "rgb10", colour(0)))),
        Says(
            "{root}/take/take.mcap: /camera/color/image_raw: holds rgb10 images, not colour; choose another"
            " topic with --rgb-topic, or convert the images to one of rgb8, 8UC3, bgr8, rgba8, bgra8, mono8, y8,"
            " 8UC1, bayer_rggb8, bayer_bggr8, bayer_gbrg8, bayer_grbg8, yuv422, uyvy, yuv422_yuy2, yuyv"
        ),
    ),
    Case(
        "broken JPEG",
        bag("mcap", with_all(RGB, lambda to, at: to.compressed(at, "jpeg", b"\xff\xd8\xff" + NOISE))),
        Says("{root}/take/take.mcap: /camera/color/image_raw: is truncated or broken; copy or download it again"),
    ),
    Case(
        "compressed depth breaks off",
        bag("mcap", with_all(DEPTH, lambda to, at: to.compressed(at, "16UC1; compressedDepth", b"1234"))),
        Says(
            "{root}/take/take.mcap: /camera/aligned_depth_to_color/image_raw: is no image, or none of PNG,"
            " JPEG or TIFF; copy or export it again"
        ),
    ),
    Case(
        "a camera of NaN",
        bag("mcap", camera([float("nan"), *K[1:]])),
        Says(
            "{root}/take/take.mcap: /camera/color/camera_info: fx: input should be a finite number, got"
            " nan; correct the camera"
        ),
    ),
    Case(
        "a camera that was never calibrated",
        bag("mcap", camera(9 * [0.0])),
        Says(
            "{root}/take/take.mcap: /camera/color/camera_info: fx: input should be greater than or equal to"
            " 1, got 0.0; correct the camera"
        ),
    ),
    Case(
        "a fisheye lens",
        bag("mcap", camera(K, (0.1, 0.2, 0.3, 0.4), "equidistant")),
        Says(
            "{root}/take/take.mcap: /camera/color/camera_info has the unsupported distortion model"
            " equidistant; record rectified images, or give --camera with k1, k2, p1, p2, k3"
        ),
    ),
    Case(
        "a topic that is not there",
        all_of(bag("mcap"), options("--depth-topic", "/depth")),
        Says(
            "{root}/take/take.mcap: has no images on /depth; set --depth-topic to one of"
            " /camera/aligned_depth_to_color/image_raw, /camera/color/image_raw"
        ),
    ),
    Case(
        "--fps",
        all_of(bag("mcap"), options("--fps", "30")),
        Says("{root}/take/take.mcap: is a bag, --fps means nothing to it; leave it out"),
    ),
]
