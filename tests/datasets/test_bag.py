"""Bags: every kind of file, every kind of image, guessed topics, and what can be wrong with them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.bags import DEPTH, INFO, KINDS, RGB, Kind, Message, Messages, compressed_depth, png
from helpers.tiny_images import HEIGHT, WIDTH, as_rgb, colour_of, depth_of
from PIL import Image

from v3d_torch.datasets import SourceOptions, load_sequence
from v3d_torch.datasets.bag import BagSequence
from v3d_torch.datasets.bag_images import colour_from, depth_from
from v3d_torch.datasets.bag_topics import CAMERA_INFO, COMPRESSED, IMAGE, choose_topics
from v3d_torch.datasets.demo.sequence import write_sequence
from v3d_torch.datasets.stored import Cursor
from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.errors import InputError
from v3d_torch.evaluation import evaluate
from v3d_torch.geometry.camera import PinholeCamera

K = [30.0, 0, 15.5, 0, 31.0, 11.5, 0, 0, 1]
P = [28.0, 0, 15.0, 0, 0, 29.0, 11.0, 0, 0, 0, 1, 0]
D = [0.1, -0.2, 0.003, 0.004, 0.05]
ROS2 = Messages("db3")


def usual(make: Messages, frames: int = 3) -> list[Message]:
    """Colour at 10, 10.1, ... seconds, depth 4 ms later; all arrive half a second late."""
    messages: list[Message] = [(INFO, 10.5, make.info(WIDTH, HEIGHT, K, D, P)), ("/imu", 10.5, make.header(10, ""))]
    for i in range(frames):
        stamp = 10 + i / 10
        messages.append((RGB, stamp + 0.5, make.image(stamp, "rgb8", colour_of(i))))
        messages.append((DEPTH, stamp + 0.504, make.image(stamp + 0.004, "16UC1", depth_of(i))))
    return messages


def assert_frame(sequence: BagSequence, index: int, seed: int) -> None:
    frame = sequence[index]
    assert np.array_equal(as_rgb(frame.image), colour_of(seed))
    assert (frame.image.dtype, frame.depth.dtype) == (torch.uint8, torch.float32)
    np.testing.assert_allclose(frame.depth[0], depth_of(seed) / 1000, rtol=1e-6)


# --- every kind of file


@pytest.mark.parametrize("kind", KINDS)
def test_frames_in_any_order(kind: Kind, tmp_path: Path) -> None:
    make = Messages(kind)
    path = make.write(tmp_path / "take", usual(make))
    sequence = load_sequence(str(path))
    assert isinstance(sequence, BagSequence)
    assert (sequence.name, sequence.groundtruth) == ("take", None)
    assert sequence.stamps.tolist() == pytest.approx([10, 10.1, 10.2], abs=1e-9)
    assert sequence.camera == PinholeCamera(30, 31, 15.5, 11.5, WIDTH, HEIGHT, tuple(D), depth_scale=1000)
    for index in (0, 1, 2, 2, 0):
        assert_frame(sequence, index, index)
    assert [frame.index for frame in sequence] == [0, 1, 2]


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_a_file_of_a_ros2_bag_alone(kind: Kind, tmp_path: Path) -> None:
    make = Messages(kind)
    (file,) = make.write(tmp_path / "take", usual(make)).glob(f"*.{kind}")
    sequence = load_sequence(str(file))
    assert isinstance(sequence, BagSequence)
    assert_frame(sequence, 2, 2)


def test_stamps_are_the_headers_else_those_of_arrival(tmp_path: Path) -> None:
    unset = [(topic, at, message) for topic, at, message in usual(ROS2)]
    for topic, _, message in unset:
        if topic in (RGB, DEPTH):
            message.header.stamp.sec = message.header.stamp.nanosec = 0
    sequence = load_sequence(str(ROS2.write(tmp_path / "take", unset)))
    assert sequence.stamps.tolist() == pytest.approx([10.5, 10.6, 10.7])


def test_a_clock_that_goes_back_and_frames_without_partner(tmp_path: Path) -> None:
    messages = usual(ROS2, 2)
    messages.append((RGB, 11.0, ROS2.image(10.05, "rgb8", colour_of(7))))  # both late
    messages.append((DEPTH, 11.0, ROS2.image(10.05, "16UC1", depth_of(7))))
    messages.append((RGB, 11.1, ROS2.image(10.6, "rgb8", colour_of(8))))  # no depth
    messages.append((DEPTH, 11.2, ROS2.image(10.69, "16UC1", depth_of(9))))
    messages.append((RGB, 11.3, ROS2.image(10.7, "rgb8", colour_of(9))))  # depth came first
    sequence = load_sequence(str(ROS2.write(tmp_path / "take", messages)))
    assert isinstance(sequence, BagSequence)
    assert sequence.stamps.tolist() == pytest.approx([10, 10.1, 10.7])
    assert_frame(sequence, 2, 9)


def test_cursor_opens_again_only_to_go_back() -> None:
    opened = 0

    def start() -> Any:
        nonlocal opened
        opened += 1
        return iter("abcde")

    cursor = Cursor(start)
    assert [cursor[i] for i in (0, 1, 3, 3, 4)] == list("abdde") and opened == 1
    assert [cursor[i] for i in (1, 2, 0)] == list("bca") and opened == 3
    with pytest.raises(IndexError):
        cursor[5]
    assert cursor[2] == "c"


# --- every kind of image


@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("rgb8", colour_of(0)),
        ("bgr8", colour_of(0)[..., ::-1]),
        ("8UC3", colour_of(0)[..., ::-1]),
        ("rgba8", np.dstack([colour_of(0), colour_of(1)[..., :1]])),
        ("bgra8", np.dstack([colour_of(0)[..., ::-1], colour_of(1)[..., :1]])),
    ],
)
@pytest.mark.parametrize("pad", [0, 5])
def test_colour_encodings(encoding: str, pixels: Any, pad: int) -> None:
    image = colour_from(ROS2.image(1, encoding, pixels, pad=pad), "x")
    assert image.dtype == torch.uint8 and np.array_equal(as_rgb(image), colour_of(0))


def test_images_are_copies() -> None:
    """A bag's memory is used again, and a camera's."""
    for encoding, read in (("rgb8", colour_from), ("16UC1", lambda *message: depth_from(message[0], 1000, message[1]))):
        message = ROS2.image(1, encoding, colour_of(0) if encoding == "rgb8" else depth_of(0))
        image = read(message, "x")
        before = image.clone()
        message.data[:] = 7
        assert torch.equal(image, before)


def test_grey_and_mosaics() -> None:
    grey = colour_of(0)[..., 0]
    for encoding in ("mono8", "8UC1"):
        assert np.array_equal(as_rgb(colour_from(ROS2.image(1, encoding, grey), "x")), np.dstack([grey] * 3))
    # A red scene: red sits where the encoding's name says.
    for encoding, (row, column) in {"rggb": (0, 0), "grbg": (0, 1), "gbrg": (1, 0), "bggr": (1, 1)}.items():
        mosaic = np.zeros((HEIGHT, WIDTH), np.uint8)
        mosaic[row::2, column::2] = 200
        image = colour_from(ROS2.image(1, f"bayer_{encoding}8", mosaic), "x")[:, 4:-4, 4:-4]
        assert image[0].min() == 200 and image[1:].max() == 0
    for encoding, (y, u, v) in {
        "yuv422": (1, 0, 2),
        "uyvy": (1, 0, 2),
        "yuyv": (0, 1, 3),
        "yuv422_yuy2": (0, 1, 3),
    }.items():
        packed = np.zeros((HEIGHT, WIDTH // 2, 4), np.uint8)
        packed[..., [y, (y + 2)]], packed[..., u], packed[..., v] = 81, 90, 240  # red in BT.601
        image = colour_from(ROS2.image(1, encoding, packed.reshape(HEIGHT, WIDTH, 2)), "x")
        assert image[0].min() > 250 and image[1:].max() < 5


def test_compressed_colour() -> None:
    png_image = colour_from(ROS2.compressed(1, "rgb8; png compressed bgr8", png(colour_of(0))), "x")
    assert np.array_equal(as_rgb(png_image), colour_of(0))
    file = BytesIO()
    Image.new("RGB", (WIDTH, HEIGHT), (250, 120, 10)).save(file, "jpeg", quality=100)
    image = colour_from(ROS2.compressed(1, "bgr8; jpeg compressed bgr8", file.getvalue()), "x")
    assert (image[:, 8, 8].int() - torch.tensor([250, 120, 10])).abs().max() <= 2


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("pad", [0, 6])
def test_convention_depth_is_metres_and_zero_is_none(big: bool, pad: int) -> None:
    units = depth_of(0)
    for encoding in ("16UC1", "mono16"):
        depth = depth_from(ROS2.image(1, encoding, units, pad=pad, big=big), 1000, "x")
        np.testing.assert_allclose(depth[0], units / 1000, rtol=1e-6)
    metric = (units / 1000).astype(np.float32)
    metric[0, :4] = [np.nan, np.inf, -np.inf, -1]
    depth = depth_from(ROS2.image(1, "32FC1", metric, pad=pad, big=big), 5000, "x")
    expected = np.where(np.isfinite(metric) & (metric > 0), metric, 0)
    assert depth.dtype == torch.float32 and np.array_equal(depth[0].numpy(), expected)


def test_compressed_depth() -> None:
    units = depth_of(0)
    for form in ("16UC1; compressedDepth", "16UC1; compressedDepth png"):
        depth = depth_from(ROS2.compressed(1, form, compressed_depth(units)), 1000, "x")
        np.testing.assert_allclose(depth[0], units / 1000, rtol=1e-6)
    depth = depth_from(ROS2.compressed(1, "16UC1; png compressed ", png(units)), 1000, "x")
    np.testing.assert_allclose(depth[0], units / 1000, rtol=1e-6)
    # Floats are stored as 1/depth in 16 bits, with the transport's defaults: quantisation 100, at most 10 m.
    a, farthest = 100.0 * 101.0, 10.0
    b = 1 - a / farthest
    metric = np.linspace(0.3, 9.9, WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)
    stored = np.rint(a / metric + b).astype(np.uint16)
    stored[0, 0] = 0
    depth = depth_from(ROS2.compressed(1, "32FC1; compressedDepth", compressed_depth(stored, a, b)), 1000, "x")
    assert depth[0, 0, 0] == 0
    np.testing.assert_allclose(depth[0].numpy().flat[1:], metric.flat[1:], atol=0.5 * 9.9**2 / a * 1.1)


@pytest.mark.parametrize(
    ("read", "message", "what"),
    [
        ("colour", ROS2.image(1, "16UC1", depth_of(0)), "holds 16UC1 images, not colour; .*--rgb-topic"),
        ("depth", ROS2.image(1, "rgb8", colour_of(0)), "holds rgb8 images, not depth; .*--depth-topic"),
        ("depth", ROS2.compressed(1, "16UC1; compressedDepth rvl", b"1" * 40), "RVL cannot be read"),
        ("depth", ROS2.compressed(1, "16UC1; compressedDepth", b"1" * 40), "is not a PNG"),
        ("depth", ROS2.compressed(1, "mono8; png compressed", png(colour_of(0)[..., 0])), "8-bit"),
        ("colour", ROS2.compressed(1, "bgr8; jpeg compressed bgr8", png(colour_of(0))[:-40]), "truncated"),
        (
            "colour",
            ROS2.compressed(1, "16UC1; png compressed", png(depth_of(0))),
            "16-bit depth image, expected a colour image",
        ),
    ],
)
def test_images_that_are_wrong(read: str, message: Any, what: str) -> None:
    with pytest.raises(InputError, match=f"^here: .*{what}"):
        colour_from(message, "here") if read == "colour" else depth_from(message, 1000, "here")


def test_an_image_with_too_little_data() -> None:
    message = ROS2.image(1, "rgb8", colour_of(0))
    message.data = message.data[:-1]
    with pytest.raises(InputError, match="less data than its 32x24 pixels"):
        colour_from(message, "here")


# --- the camera


def camera_of(path: Path, *messages: Message, **options: str) -> PinholeCamera:
    bag = ROS2.write(path / "take", [message for message in usual(ROS2) if message[0] != INFO] + list(messages))
    return load_sequence(str(bag), options=SourceOptions(**options)).camera


def test_rectified_images_have_the_projection_and_no_lens(tmp_path: Path) -> None:
    rectified = RGB.replace("image_raw", "image_rect_color")
    messages = [(rectified if topic == RGB else topic, at, message) for topic, at, message in usual(ROS2)]
    camera = load_sequence(str(ROS2.write(tmp_path / "take", messages))).camera
    assert camera == PinholeCamera(28, 29, 15, 11, WIDTH, HEIGHT, depth_scale=1000)


def test_lens_models(tmp_path: Path) -> None:
    for number, (lens, model) in enumerate([([], ""), (D[:4], "plumb_bob"), ([*D, 0, 0, 0], "rational_polynomial")]):
        folder = tmp_path / str(number)
        folder.mkdir()
        camera = camera_of(folder, (INFO, 10.5, ROS2.info(WIDTH, HEIGHT, K, lens, P, model)))
        assert camera.distortion == tuple((lens + [0.0] * 5)[:5])
    for lens, model in (([*D, 0.1, 0, 0], "rational_polynomial"), (D[:4], "equidistant")):
        folder = tmp_path / model
        folder.mkdir()
        with pytest.raises(InputError, match=f"{INFO} has a lens of the kind {model}"):
            camera_of(folder, (INFO, 10.5, ROS2.info(WIDTH, HEIGHT, K, lens, P, model)))


def test_another_camera_topic(tmp_path: Path) -> None:
    message = ROS2.info(WIDTH, HEIGHT, K, D, P)
    assert camera_of(tmp_path, ("/my/camera", 10.5, message), info_topic="/my/camera").fx == 30


def test_the_users_camera_sets_the_unit_of_depth(tmp_path: Path) -> None:
    bag = ROS2.write(tmp_path / "take", [message for message in usual(ROS2) if message[0] != INFO])
    own = PinholeCamera(1, 2, 3, 4, WIDTH, HEIGHT, depth_scale=5000)
    sequence = load_sequence(str(bag), camera=own)
    assert sequence.camera is own
    np.testing.assert_allclose(sequence[0].depth[0], depth_of(0) / 5000, rtol=1e-6)


# --- topics

REALSENSE = {
    "/camera/camera/color/image_raw": IMAGE,
    "/camera/camera/color/image_raw/compressed": COMPRESSED,
    "/camera/camera/color/camera_info": CAMERA_INFO,
    "/camera/camera/depth/image_rect_raw": IMAGE,
    "/camera/camera/depth/camera_info": CAMERA_INFO,
    "/camera/camera/aligned_depth_to_color/image_raw": IMAGE,
    "/camera/camera/aligned_depth_to_color/image_raw/compressedDepth": COMPRESSED,
    "/camera/camera/aligned_depth_to_color/camera_info": CAMERA_INFO,
    "/camera/camera/infra1/image_rect_raw": IMAGE,
    "/imu": "sensor_msgs/msg/Imu",
}
KINECT = {
    "/camera/rgb/image_color": IMAGE,
    "/camera/rgb/camera_info": CAMERA_INFO,
    "/camera/depth/image": IMAGE,
    "/camera/depth/camera_info": CAMERA_INFO,
    "/cortex_marker_array": "visualization_msgs/msg/MarkerArray",
}
COMPRESSED_ONLY = {
    "/d400/color/image_raw/compressed": COMPRESSED,
    "/d400/color/camera_info": CAMERA_INFO,
    "/d400/aligned_depth_to_color/image_raw/compressed": COMPRESSED,
    "/d400/aligned_depth_to_color/image_raw/compressedDepth": COMPRESSED,
    "/t265/fisheye1/image_raw": IMAGE,
}
UNLABELLED = {"/sim/image": IMAGE, "/sim/camera_info": CAMERA_INFO, "/sim/depth": IMAGE}


@pytest.mark.parametrize(
    ("types", "rgb", "depth", "info"),
    [
        (
            REALSENSE,
            "/camera/camera/color/image_raw",
            "/camera/camera/aligned_depth_to_color/image_raw",
            "/camera/camera/color/camera_info",
        ),
        (KINECT, "/camera/rgb/image_color", "/camera/depth/image", "/camera/rgb/camera_info"),
        (
            COMPRESSED_ONLY,
            "/d400/color/image_raw/compressed",
            "/d400/aligned_depth_to_color/image_raw/compressedDepth",
            "/d400/color/camera_info",
        ),
        (UNLABELLED, "/sim/image", "/sim/depth", "/sim/camera_info"),
    ],
)
def test_topics_are_guessed(types: dict[str, str], rgb: str, depth: str, info: str) -> None:
    topics = choose_topics("bag", types)
    assert (topics.rgb, topics.depth, topics.info) == (rgb, depth, info)


def test_two_cameras() -> None:
    both = {f"/{name}{topic}": kind for name in ("left", "right") for topic, kind in KINECT.items()}
    with pytest.raises(InputError, match="bag: has several topics of colour images; give --rgb-topic one of /left/cam"):
        choose_topics("bag", both)
    topics = choose_topics("bag", both, rgb="/right/camera/rgb/image_color")
    assert (topics.depth, topics.info) == ("/right/camera/depth/image", "/right/camera/rgb/camera_info")
    topics = choose_topics("bag", both, "/right/camera/rgb/image_color", "/left/camera/depth/image")
    assert topics.depth == "/left/camera/depth/image"


def test_a_depth_topic_under_any_name() -> None:
    types = {"/a": IMAGE, "/b": IMAGE}
    assert choose_topics("bag", types, depth="/a").rgb == "/b"


@pytest.mark.parametrize(
    ("topics", "options", "message"),
    [
        ([RGB, INFO], {}, f"no topic has the name of depth images; give --depth-topic one of {RGB}$"),
        ([DEPTH, INFO], {}, f"no topic has the name of colour images; give --rgb-topic one of {DEPTH}$"),
        ([INFO], {}, "holds no images; record the topics of colour, of depth"),
        ([RGB, DEPTH, INFO], {"rgb_topic": "/x"}, f"has no images on /x; give --rgb-topic one of {DEPTH}, {RGB}$"),
        ([RGB, DEPTH, INFO], {"info_topic": "/x"}, f"has no camera on /x; give --info-topic one of {INFO}$"),
        ([RGB, DEPTH], {}, f"has no camera beside {RGB}; name it with --info-topic, or give --camera$"),
        ([RGB, DEPTH, INFO], {"rgb_topic": DEPTH, "depth_topic": RGB, "info_topic": INFO}, "16UC1 images, not colour"),
        ([RGB, DEPTH, INFO], {"fps": 30.0}, "is a bag, which does not support --fps"),
    ],
)
def test_topics_that_are_wrong(topics: list[str], options: dict[str, Any], message: str, tmp_path: Path) -> None:
    path = ROS2.write(tmp_path / "take", [each for each in usual(ROS2) if each[0] in topics])
    with pytest.raises(InputError, match=message) as caught:
        load_sequence(str(path), options=SourceOptions(**options))
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


# --- what else can be wrong


def changed(tmp_path: Path, **change: Any) -> Path:
    """A bag whose depth messages are made otherwise."""
    messages = [message for message in usual(ROS2) if message[0] != DEPTH]
    for i in range(3):
        stamp = change.get("stamp", 10) + i / 10
        pixels = depth_of(i, *change.get("size", (WIDTH, HEIGHT)))
        message = ROS2.image(stamp, "16UC1", pixels, frame=change.get("frame", "optical"))
        messages.append((change.get("topic", DEPTH), stamp + 0.5, message))
    return ROS2.write(tmp_path / "take", messages)


def test_depth_that_is_not_registered_to_colour(tmp_path: Path) -> None:
    """Told by the frame that it is seen from, unless its name or the user says that it is registered."""
    path = changed(tmp_path, topic="/camera/depth/image_rect_raw", frame="/depth_frame")
    with pytest.raises(
        InputError, match=r"image_rect_raw is seen from depth_frame, colour from optical; .*--depth-topic"
    ):
        load_sequence(str(path))
    assert len(load_sequence(str(path), options=SourceOptions(depth_topic="/camera/depth/image_rect_raw"))) == 3
    (tmp_path / "aligned").mkdir()
    assert len(load_sequence(str(changed(tmp_path / "aligned", frame="/depth_frame")))) == 3


def test_depth_of_another_size(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=": has 40x24 pixels, but its colour image has 32x24; name depth"):
        load_sequence(str(changed(tmp_path, size=(40, HEIGHT))))


def test_depth_of_another_time(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no image on .* lies within 0.02 s"):
        load_sequence(str(changed(tmp_path, stamp=20)))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("keep", [0, 60, 0.5])
def test_a_truncated_bag(kind: Kind, keep: float, tmp_path: Path) -> None:
    make = Messages(kind)
    path = make.write(tmp_path / "take", usual(make))
    file = path if kind == "bag" else next(path.glob(f"*.{kind}"))
    content = file.read_bytes()
    file.write_bytes(content[: int(keep * len(content)) if keep < 1 else int(keep)])
    with pytest.raises(InputError, match="is no whole bag") as caught:
        list(load_sequence(str(path)))
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_without_rosbags(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = ROS2.write(tmp_path / "take", usual(ROS2))
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    with pytest.raises(InputError, match=r"reading a bag needs rosbags .*pip install rosbags"):
        load_sequence(str(path))


# --- the command


def test_a_run_on_a_bag(tmp_path: Path) -> None:
    """Ten frames of the demo as a ROS 1 bag."""
    write_sequence(tmp_path / "folder", range(10))
    folder = load_sequence(str(tmp_path / "folder"))
    make, camera = Messages("bag"), folder.camera
    k = [camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1]
    messages: list[Message] = [("/kinect/rgb/info", 1.0, make.info(640, 480, k, [], P))]
    for frame in folder:
        images = ("rgb", "rgb8", as_rgb(frame.image)), ("depth", "32FC1", frame.depth[0].numpy())
        for what, encoding, pixels in images:
            messages.append((f"/kinect/{what}/image", frame.stamp, make.image(frame.stamp, encoding, pixels)))
    bag = make.write(tmp_path / "demo", messages)
    arguments = ["--seq", bag, "--info-topic", "/kinect/rgb/info", "--segmenter", "none", "--out", tmp_path / "out"]
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-m", "v3d_torch.run", *map(str, arguments), "--set", "threads=1"],
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "NO_COLOR": "1"},
    )
    assert (done.returncode, done.stderr) == (0, "")
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert (metrics["sequence"], metrics["frames"], metrics["tracked"]) == ("demo", 10, 10)
    trajectory = read_trajectory(tmp_path / "out" / "trajectory.txt")
    assert trajectory.stamps.tolist() == pytest.approx(folder.stamps.tolist(), abs=1e-6)
    assert folder.groundtruth is not None
    assert evaluate(folder.groundtruth, trajectory).ate.rmse < 0.005
