"""Cases with bags of ROS 1, ROS 2 and mcap."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from pathlib import Path

import numpy as np

from helpers.bags import DEPTH, INFO, RGB, Kind, Message, MessageFactory
from helpers.corpus.base import FOCAL, FRAMES, HEIGHT, NOISE, WIDTH, camera_position, colour, depth
from helpers.corpus.case import Case, Damage, Fails, Succeeds, Workspace, add_options, all_of, first_half, set_sequence

K = [FOCAL, 0, (WIDTH - 1) / 2, 0, FOCAL, (HEIGHT - 1) / 2, 0, 0, 1]
P = [*K[:3], 0, *K[3:6], 0, *K[6:], 0]
MILLIMETRES = (depth() // 5).astype(np.uint16)

Change = Callable[[MessageFactory, list[Message]], list[Message]]


def bag(kind: Kind, change: Change | None = None) -> Damage:
    """Write the sequence as a bag with changed messages; of a ROS 2 bag, give its file next to metadata.yaml."""

    def make(place: Workspace) -> None:
        make_message = MessageFactory(kind)
        messages: list[Message] = [(INFO, 10.0, make_message.info(WIDTH, HEIGHT, K, [], P))]
        for i in range(FRAMES):
            stamp = 10 + i / 10
            messages.append((RGB, stamp, make_message.image(stamp, "bgr8", colour(*camera_position(i)))))
            messages.append((DEPTH, stamp, make_message.image(stamp, "16UC1", MILLIMETRES)))
        path = make_message.write(
            place.root / "take", change(make_message, messages) if change is not None else messages
        )
        place.seq = str(path if kind == "bag" else next(path.glob(f"*.{kind}")))

    return make


def remove_topic(topic: str) -> Change:
    return lambda to, messages: [message for message in messages if message[0] != topic]


def replace_messages(topic: str, content: Callable[[MessageFactory, float], object]) -> Change:
    """Replace all messages on a topic."""

    def change(to: MessageFactory, messages: list[Message]) -> list[Message]:
        return [(name, at, content(to, at) if name == topic else message) for name, at, message in messages]

    return change


def replace_camera(k: list[float], d: tuple[float, ...] = (), model: str = "plumb_bob") -> Change:
    return replace_messages(INFO, lambda to, at: to.info(WIDTH, HEIGHT, k, list(d), P, model))


def image_shorter_than_its_height(to: MessageFactory, at: float) -> object:
    message = to.image(at, "bgr8", colour(0))
    message.height = 10**6
    return message


def image_without_pixels(to: MessageFactory, at: float) -> object:
    message = to.image(at, "bgr8", colour(0))
    message.height = message.width = message.step = 0
    message.data = np.zeros(0, np.uint8)
    return message


def depth_with_nan(to: MessageFactory, at: float) -> object:
    metres = (depth() / 5000).astype(np.float32)
    metres[:, ::8] = np.nan
    return to.image(at, "32FC1", metres)


def change_bytes(change: Callable[[bytes], bytes]) -> Damage:
    """Change the bytes of the bag file."""

    def make(place: Workspace) -> None:
        path = Path(place.seq)
        path.write_bytes(change(path.read_bytes()))

    return make


def noise(name: str) -> Damage:
    """Write a file of random bytes and give it as the sequence."""
    return all_of(lambda place: (place.root / name).write_bytes(NOISE), set_sequence("{root}/" + name))


def unrelated_database(place: Workspace) -> None:
    with sqlite3.connect(place.root / "notes.db3") as database:
        database.execute("CREATE TABLE notes (text TEXT)")
    database.close()


def damaged_metadata(place: Workspace) -> None:
    (place.root / "take" / "metadata.yaml").write_text("rosbag2_bagfile_information: [")


CASES = [
    Case("valid ROS 1 bag", bag("bag"), Succeeds(max_ate=None)),
    Case("valid ROS 2 bag", bag("db3"), Succeeds(max_ate=None)),
    Case("valid mcap", bag("mcap"), Succeeds(max_ate=None)),
    Case(
        "truncated ROS 1 bag",
        all_of(bag("bag"), change_bytes(first_half)),
        Fails("{root}/take.bag: is damaged or not a bag (...); copy it again, or repair it with rosbag reindex"),
    ),
    Case(
        "truncated ROS 2 bag",
        all_of(bag("db3"), change_bytes(first_half)),
        Fails("{root}/take/take.db3: is damaged or not a bag (...); copy it again, or repair it with ros2 bag reindex"),
    ),
    Case(
        "truncated mcap",
        all_of(bag("mcap"), change_bytes(first_half)),
        Fails("{root}/take/take.mcap: is damaged or not a bag (...); copy it again, or repair it with mcap recover"),
    ),
    Case(
        "empty ROS 1 bag",
        all_of(bag("bag"), change_bytes(lambda content: b"")),
        Fails("{root}/take.bag: is damaged or not a bag (...); copy it again, or repair it with rosbag reindex"),
    ),
    Case(
        "empty ROS 2 bag",
        all_of(bag("db3"), change_bytes(lambda content: b"")),
        Fails("{root}/take/take.db3: is damaged or not a bag (...); copy it again, or repair it with ros2 bag reindex"),
    ),
    Case(
        "empty mcap",
        all_of(bag("mcap"), change_bytes(lambda content: b"")),
        Fails("{root}/take/take.mcap: is damaged or not a bag (...); copy it again, or repair it with mcap recover"),
    ),
    Case(
        "random bytes as a ROS 1 bag",
        noise("take.bag"),
        Fails("{root}/take.bag: is damaged or not a bag (...); copy it again, or repair it with rosbag reindex"),
    ),
    Case(
        "random bytes as a ROS 2 bag",
        noise("take.db3"),
        Fails("{root}/take.db3: is damaged or not a bag (...); copy it again, or repair it with ros2 bag reindex"),
    ),
    Case(
        "random bytes as an mcap",
        noise("take.mcap"),
        Fails("{root}/take.mcap: is damaged or not a bag (...); copy it again, or repair it with mcap recover"),
    ),
    Case(
        "unrelated SQLite database",
        all_of(unrelated_database, set_sequence("{root}/notes.db3")),
        Fails("{root}/notes.db3: is damaged or not a bag (...); copy it again, or repair it with ros2 bag reindex"),
    ),
    Case(
        "ROS 2 folder with damaged metadata",
        all_of(bag("db3"), damaged_metadata, set_sequence("{root}/take")),
        Fails("{root}/take: is damaged or not a bag (...); copy it again, or repair it with ros2 bag reindex"),
    ),
    Case(
        "no camera",
        bag("mcap", remove_topic(INFO)),
        Fails(
            "{root}/take/take.mcap: has no CameraInfo topic for /camera/color/image_raw; name it"
            " with --info-topic, or pass --camera"
        ),
    ),
    Case(
        "no depth",
        bag("bag", remove_topic(DEPTH)),
        Fails(
            "{root}/take.bag: no topic is named like depth images; set --depth-topic to one of /camera/color/image_raw"
        ),
    ),
    Case(
        "no colour",
        bag("mcap", remove_topic(RGB)),
        Fails(
            "{root}/take/take.mcap: no topic is named like colour images; set --rgb-topic to one of"
            " /camera/aligned_depth_to_color/image_raw"
        ),
    ),
    Case(
        "no images",
        bag("bag", lambda to, messages: messages[:1]),
        Fails("{root}/take.bag: contains no images; record the colour, depth and CameraInfo topics"),
    ),
    Case(
        "no common stamps",
        bag("db3", replace_messages(DEPTH, lambda to, at: to.image(at + 100, "16UC1", MILLIMETRES))),
        Fails(
            "{root}/take/take.db3: no image on /camera/color/image_raw is within 0.02 s of an image on"
            " /camera/aligned_depth_to_color/image_raw; choose other topics with --rgb-topic and --depth-topic"
        ),
    ),
    Case(
        "8-bit depth",
        bag("mcap", replace_messages(DEPTH, lambda to, at: to.image(at, "mono8", colour(0)[..., 0]))),
        Fails(
            "{root}/take/take.mcap: /camera/aligned_depth_to_color/image_raw: holds mono8 images, not"
            " depth; choose another topic with --depth-topic"
        ),
    ),
    Case(
        "depth on the colour topic",
        bag("mcap", replace_messages(RGB, lambda to, at: to.image(at, "16UC1", MILLIMETRES))),
        Fails(
            "{root}/take/take.mcap: /camera/color/image_raw: holds 16UC1 images, not colour; choose another"
            " topic with --rgb-topic, or convert the images to one of rgb8, 8UC3, bgr8, rgba8, bgra8, mono8, y8,"
            " 8UC1, bayer_rggb8, bayer_bggr8, bayer_gbrg8, bayer_grbg8, yuv422, uyvy, yuv422_yuy2, yuyv"
        ),
    ),
    Case(
        "depth of another size",
        bag("mcap", replace_messages(DEPTH, lambda to, at: to.image(at, "16UC1", MILLIMETRES[::2]))),
        Fails(
            "{root}/take/take.mcap: /camera/aligned_depth_to_color/image_raw: has 128x48 pixels, but its colour"
            " image has 128x96; choose depth registered to colour with --depth-topic"
        ),
    ),
    Case("depth with NaN", bag("mcap", replace_messages(DEPTH, depth_with_nan)), Succeeds(max_ate=None)),
    Case(
        "images with too little data",
        bag("mcap", replace_messages(RGB, image_shorter_than_its_height)),
        Fails(
            "{root}/take/take.mcap: /camera/color/image_raw: an image has less data than its 128x1000000"
            " pixels need; record the bag again"
        ),
    ),
    Case(
        "images without pixels",
        bag("mcap", replace_messages(RGB, image_without_pixels)),
        Fails("{root}/take/take.mcap: /camera/color/image_raw: an image has no pixels; record the bag again"),
    ),
    Case(
        "unsupported encoding",
        bag("mcap", replace_messages(RGB, lambda to, at: to.image(at, "rgb10", colour(0)))),
        Fails(
            "{root}/take/take.mcap: /camera/color/image_raw: holds rgb10 images, not colour; choose another"
            " topic with --rgb-topic, or convert the images to one of rgb8, 8UC3, bgr8, rgba8, bgra8, mono8, y8,"
            " 8UC1, bayer_rggb8, bayer_bggr8, bayer_gbrg8, bayer_grbg8, yuv422, uyvy, yuv422_yuy2, yuyv"
        ),
    ),
    Case(
        "damaged JPEG",
        bag("mcap", replace_messages(RGB, lambda to, at: to.compressed(at, "jpeg", b"\xff\xd8\xff" + NOISE))),
        Fails("{root}/take/take.mcap: /camera/color/image_raw: is truncated or damaged; copy or download it again"),
    ),
    Case(
        "truncated compressed depth",
        bag("mcap", replace_messages(DEPTH, lambda to, at: to.compressed(at, "16UC1; compressedDepth", b"1234"))),
        Fails(
            "{root}/take/take.mcap: /camera/aligned_depth_to_color/image_raw: is not a PNG, JPEG or TIFF image;"
            " copy or export it again"
        ),
    ),
    Case(
        "NaN in the camera",
        bag("mcap", replace_camera([float("nan"), *K[1:]])),
        Fails(
            "{root}/take/take.mcap: /camera/color/camera_info: fx: input should be a finite number, got"
            " nan; correct the camera"
        ),
    ),
    Case(
        "uncalibrated camera",
        bag("mcap", replace_camera(9 * [0.0])),
        Fails(
            "{root}/take/take.mcap: /camera/color/camera_info: fx: input should be greater than or equal to"
            " 1, got 0.0; correct the camera"
        ),
    ),
    Case(
        "unsupported distortion model",
        bag("mcap", replace_camera(K, (0.1, 0.2, 0.3, 0.4), "thin_prism")),
        Fails(
            "{root}/take/take.mcap: /camera/color/camera_info: the distortion model thin_prism is not supported;"
            " calibrate with one of plumb_bob, rational_polynomial, equidistant"
        ),
    ),
    Case(
        "missing topic",
        all_of(bag("mcap"), add_options("--depth-topic", "/depth")),
        Fails(
            "{root}/take/take.mcap: has no images on /depth; set --depth-topic to one of"
            " /camera/aligned_depth_to_color/image_raw, /camera/color/image_raw"
        ),
    ),
    Case(
        "--fps for a bag",
        all_of(bag("mcap"), add_options("--fps", "30")),
        Fails("{root}/take/take.mcap: is a bag, which does not support --fps; remove this option"),
    ),
]
