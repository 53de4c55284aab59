"""Sequences in bags of ROS 1, ROS 2 and mcap: frames, stamps, cameras, invalid bags, and a run of the command."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.bags import DEPTH, INFO, KINDS, RGB, Kind, Message, MessageFactory
from helpers.commands import call_here
from helpers.demo_frames import copy_frames
from helpers.tiny_images import CAMERA_YAML, HEIGHT, WIDTH, as_rgb, colour_of, depth_of

from v3d_torch.datasets import SourceOptions, load_sequence
from v3d_torch.datasets.ros import BagSequence
from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.errors import InputError
from v3d_torch.evaluation import evaluate
from v3d_torch.geometry.camera import PinholeCamera

K = [30.0, 0, 15.5, 0, 31.0, 11.5, 0, 0, 1]
P = [28.0, 0, 15.0, 0, 0, 29.0, 11.0, 0, 0, 0, 1, 0]
D = [0.1, -0.2, 0.003, 0.004, 0.05]
ROS2 = MessageFactory("db3")


def valid_messages(make: MessageFactory, frames: int = 3) -> list[Message]:
    """Colour at 10, 10.1, ... seconds and depth 4 ms later; all messages arrive half a second after their stamps."""
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


# --- files and stamps


@pytest.mark.parametrize("kind", KINDS)
def test_frames_can_be_read_in_any_order(kind: Kind, tmp_path: Path) -> None:
    make = MessageFactory(kind)
    path = make.write(tmp_path / "take", valid_messages(make))
    sequence = load_sequence(str(path))
    assert isinstance(sequence, BagSequence)
    assert (sequence.name, sequence.groundtruth) == ("take", None)
    assert sequence.stamps.tolist() == pytest.approx([10, 10.1, 10.2], abs=1e-9)
    assert sequence.camera == PinholeCamera(30, 31, 15.5, 11.5, WIDTH, HEIGHT, tuple(D), depth_scale=1000)
    for index in (0, 1, 2, 2, 0):
        assert_frame(sequence, index, index)
    assert [frame.index for frame in sequence] == [0, 1, 2]


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_file_inside_a_ros2_bag_can_be_opened(kind: Kind, tmp_path: Path) -> None:
    make = MessageFactory(kind)
    (file,) = make.write(tmp_path / "take", valid_messages(make)).glob(f"*.{kind}")
    sequence = load_sequence(str(file))
    assert isinstance(sequence, BagSequence)
    assert_frame(sequence, 2, 2)


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_folder_of_a_ros2_bag_can_be_named_like_a_ros1_bag(kind: Kind, tmp_path: Path) -> None:
    make = MessageFactory(kind)
    sequence = load_sequence(str(make.write(tmp_path / "my.bag", valid_messages(make))))
    assert isinstance(sequence, BagSequence) and sequence.name == "my.bag"
    assert_frame(sequence, 2, 2)


def test_unset_header_stamps_are_replaced_by_arrival_times(tmp_path: Path) -> None:
    messages = valid_messages(ROS2)
    for topic, _, message in messages:
        if topic in (RGB, DEPTH):
            message.header.stamp.sec = message.header.stamp.nanosec = 0
    sequence = load_sequence(str(ROS2.write(tmp_path / "take", messages)))
    assert sequence.stamps.tolist() == pytest.approx([10.5, 10.6, 10.7])


def test_decreasing_stamps_and_unpaired_images_are_dropped(tmp_path: Path) -> None:
    messages = valid_messages(ROS2, 12)
    messages.append((RGB, 12.0, ROS2.image(10.05, "rgb8", colour_of(17))))  # stamped before the previous image
    messages.append((DEPTH, 12.0, ROS2.image(10.05, "16UC1", depth_of(17))))
    messages.append((RGB, 12.1, ROS2.image(11.6, "rgb8", colour_of(18))))  # no depth within the tolerance
    messages.append((DEPTH, 12.2, ROS2.image(11.69, "16UC1", depth_of(19))))
    messages.append((RGB, 12.3, ROS2.image(11.7, "rgb8", colour_of(19))))  # its depth arrived first
    sequence = load_sequence(str(ROS2.write(tmp_path / "take", messages)))
    assert isinstance(sequence, BagSequence)
    assert sequence.stamps.tolist() == pytest.approx([*(10 + i / 10 for i in range(12)), 11.7])
    assert_frame(sequence, 12, 19)
    assert sequence.notes == [
        "1 of 14 colour images have no depth image within 20 ms and are left out (the last at 11.600000 s)",
        f"{RGB}: the stamps jump back from 11.100000 to 10.050000 s after 12 images; 1 of 15 images are left out",
        f"{DEPTH}: the stamps jump back from 11.104000 to 10.050000 s after 12 images; 1 of 14 images are left out",
    ]


def write_with_stamps(path: Path, stamps: list[float]) -> Path:
    """Write a bag whose images have these stamps; they arrive a tenth of a second after each other."""
    messages: list[Message] = [(INFO, 10.0, ROS2.info(WIDTH, HEIGHT, K, D, P))]
    for i, stamp in enumerate(stamps):
        messages.append((RGB, 10 + i / 10, ROS2.image(stamp, "rgb8", colour_of(i))))
        messages.append((DEPTH, 10 + i / 10, ROS2.image(stamp, "16UC1", depth_of(i))))
    return ROS2.write(path, messages)


def test_stamps_of_a_simulation_start_at_zero(tmp_path: Path) -> None:
    stamps = [i / 10 for i in range(20)]
    sequence = load_sequence(str(write_with_stamps(tmp_path / "take", stamps)))
    assert isinstance(sequence, BagSequence)
    assert sequence.stamps.tolist() == pytest.approx(stamps) and sequence.notes == []


def test_images_that_were_published_twice_are_read_once_without_a_note(tmp_path: Path) -> None:
    sequence = load_sequence(str(write_with_stamps(tmp_path / "take", [1.0, 1.0, 2.0, 2.0, 3.0, 3.0])))
    assert isinstance(sequence, BagSequence)
    assert sequence.stamps.tolist() == [1, 2, 3] and sequence.notes == []


@pytest.mark.parametrize(
    ("stamps", "jump", "count"),
    [
        ([1.8e9, *(100 + i / 10 for i in range(30))], "1800000000.000000 to 100.000000 s after 1 images", "30 of 31"),
        (
            [*(100 + i / 10 for i in range(20)), *(100.9 + i / 10 for i in range(20))],
            "101.900000 to 100.900000 s after 20 images",
            "10 of 40",
        ),
    ],
    ids=["one wild first stamp", "set back by a second"],
)
def test_clock_that_was_set_back_is_an_input_error(stamps: list[float], jump: str, count: str, tmp_path: Path) -> None:
    path = write_with_stamps(tmp_path / "take", stamps)
    with pytest.raises(InputError, match=f"{RGB}: the stamps jump back from {jump}, and {count} images are") as caught:
        load_sequence(str(path))
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


# --- cameras


def load_camera_from_bag(path: Path, *messages: Message, **options: str) -> PinholeCamera:
    bag = ROS2.write(
        path / "take", [message for message in valid_messages(ROS2) if message[0] != INFO] + list(messages)
    )
    return load_sequence(str(bag), options=SourceOptions(**options)).camera


def test_camera_of_rectified_images_is_the_projection_matrix_without_distortion(tmp_path: Path) -> None:
    rectified = RGB.replace("image_raw", "image_rect_color")
    messages = [(rectified if topic == RGB else topic, at, message) for topic, at, message in valid_messages(ROS2)]
    camera = load_sequence(str(ROS2.write(tmp_path / "take", messages))).camera
    assert camera == PinholeCamera(28, 29, 15, 11, WIDTH, HEIGHT, depth_scale=1000)


@pytest.mark.parametrize("kind", KINDS)
def test_camera_that_changes_within_a_bag_is_noted(kind: Kind, tmp_path: Path) -> None:
    make = MessageFactory(kind)
    messages = valid_messages(make)
    for arrival, fx in ((10.55, 30.0), (10.65, 31.0)):
        messages.append((INFO, arrival, make.info(WIDTH, HEIGHT, [fx, *K[1:]], D, P)))
    path = make.write(tmp_path / "take", sorted(messages, key=lambda message: message[1]))
    sequence = load_sequence(str(path))
    assert isinstance(sequence, BagSequence) and sequence.camera.fx == 30 and len(sequence) == 3
    assert sequence.notes == [
        f"{path}: {INFO}: the camera changes at 10.650000 s (time of arrival), but all frames use the first one; cut"
        " the bag there, or pass --camera if the change is wrong"
    ]
    (tmp_path / "camera.yaml").write_text(CAMERA_YAML)
    given = load_sequence(str(path), camera=str(tmp_path / "camera.yaml"))
    assert isinstance(given, BagSequence) and given.notes == []


def test_distortion_models_are_read_or_rejected(tmp_path: Path) -> None:
    for number, (distortion, model) in enumerate(
        [([], ""), (D[:4], "plumb_bob"), ([*D, 0, 0, 0], "rational_polynomial")]
    ):
        folder = tmp_path / str(number)
        folder.mkdir()
        camera = load_camera_from_bag(folder, (INFO, 10.5, ROS2.info(WIDTH, HEIGHT, K, distortion, P, model)))
        assert camera.distortion == tuple((distortion + [0.0] * 5)[:5])
    for distortion, model in (([*D, 0.1, 0, 0], "rational_polynomial"), ([0.01, 0, 0, 0], "equidistant")):
        folder = tmp_path / model
        folder.mkdir()
        camera = load_camera_from_bag(folder, (INFO, 10.5, ROS2.info(WIDTH, HEIGHT, K, distortion, P, model)))
        assert (camera.distortion, camera.distortion_model) == (tuple(distortion), model)
    for distortion, model in ((D, "thin_prism"), ([*D, 0, 0, 0, 0.1, 0, 0, 0], "rational_polynomial")):
        folder = tmp_path / f"{model} rejected"
        folder.mkdir()
        with pytest.raises(InputError, match=f"take: {INFO}: the .*distortion .*{model}.*; (calibrate|give) "):
            load_camera_from_bag(folder, (INFO, 10.5, ROS2.info(WIDTH, HEIGHT, K, distortion, P, model)))


def test_camera_is_read_from_the_topic_of_the_user(tmp_path: Path) -> None:
    message = ROS2.info(WIDTH, HEIGHT, K, D, P)
    assert load_camera_from_bag(tmp_path, ("/my/camera", 10.5, message), info_topic="/my/camera").fx == 30


def test_camera_of_the_user_sets_the_depth_scale(tmp_path: Path) -> None:
    bag = ROS2.write(tmp_path / "take", [message for message in valid_messages(ROS2) if message[0] != INFO])
    camera = PinholeCamera(1, 2, 3, 4, WIDTH, HEIGHT, depth_scale=5000)
    sequence = load_sequence(str(bag), camera=camera)
    assert sequence.camera is camera
    np.testing.assert_allclose(sequence[0].depth[0], depth_of(0) / 5000, rtol=1e-6)


def test_camera_file_in_the_folder_of_a_bag_replaces_camera_info(tmp_path: Path) -> None:
    bag = ROS2.write(tmp_path / "take", [message for message in valid_messages(ROS2) if message[0] != INFO])
    (bag / "camera.yaml").write_text(CAMERA_YAML)
    assert load_sequence(str(bag)).camera == PinholeCamera(30, 31, 15.5, 11.5, WIDTH, HEIGHT, depth_scale=1000)


@pytest.mark.parametrize(
    ("topics", "options", "error"),
    [
        ([RGB, INFO], {}, f"no topic is named like depth images; set --depth-topic to one of {RGB}$"),
        ([DEPTH, INFO], {}, f"no topic is named like colour images; set --rgb-topic to one of {DEPTH}$"),
        ([INFO], {}, "contains no images; record the colour, depth and CameraInfo"),
        ([RGB, DEPTH, INFO], {"rgb_topic": "/x"}, f"has no images on /x; set --rgb-topic to one of {DEPTH}, {RGB}$"),
        ([RGB, DEPTH, INFO], {"info_topic": "/x"}, f"has no CameraInfo on /x; set --info-topic to one of {INFO}$"),
        ([RGB, DEPTH], {"info_topic": "/x"}, "has no CameraInfo on /x or any other topic; pass --camera instead$"),
        ([RGB, DEPTH], {}, f"has no CameraInfo topic for {RGB}; name it with --info-topic, or pass --camera$"),
        ([RGB, DEPTH, INFO], {"rgb_topic": DEPTH, "depth_topic": RGB, "info_topic": INFO}, "16UC1 images, not colour"),
        ([RGB, DEPTH, INFO], {"fps": 30.0}, "is a bag, which does not support --fps; remove this option"),
    ],
)
def test_missing_or_wrong_topics_are_an_input_error(
    topics: list[str], options: dict[str, Any], error: str, tmp_path: Path
) -> None:
    path = ROS2.write(tmp_path / "take", [message for message in valid_messages(ROS2) if message[0] in topics])
    with pytest.raises(InputError, match=error) as caught:
        load_sequence(str(path), options=SourceOptions(**options))
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


# --- invalid bags


def write_with_other_depth(tmp_path: Path, **change: Any) -> Path:
    """Write a bag whose depth messages have another stamp, size, frame_id or topic."""
    messages = [message for message in valid_messages(ROS2) if message[0] != DEPTH]
    for i in range(3):
        stamp = change.get("stamp", 10) + i / 10
        pixels = depth_of(i, *change.get("size", (WIDTH, HEIGHT)))
        message = ROS2.image(stamp, "16UC1", pixels, frame=change.get("frame", "optical"))
        messages.append((change.get("topic", DEPTH), stamp + 0.5, message))
    return ROS2.write(tmp_path / "take", messages)


def test_unregistered_depth_is_rejected_unless_name_or_user_confirms_it(tmp_path: Path) -> None:
    """Depth in another frame than colour is unregistered."""
    path = write_with_other_depth(tmp_path, topic="/camera/depth/image_rect_raw", frame="/depth_frame")
    with pytest.raises(
        InputError, match=r"image_rect_raw is in frame depth_frame, colour in frame optical; .*--depth-topic"
    ):
        load_sequence(str(path))
    assert len(load_sequence(str(path), options=SourceOptions(depth_topic="/camera/depth/image_rect_raw"))) == 3
    (tmp_path / "aligned").mkdir()
    assert len(load_sequence(str(write_with_other_depth(tmp_path / "aligned", frame="/depth_frame")))) == 3


def test_registered_depth_of_another_camera_is_rejected(tmp_path: Path) -> None:
    """The name of a topic says that depth is registered to colour, but not to that of which camera."""
    path = write_with_other_depth(tmp_path, topic="/other/aligned_depth_to_color/image_raw", frame="/other_frame")
    with pytest.raises(InputError, match=r"in frame other_frame, colour in frame optical; .*--depth-topic"):
        load_sequence(str(path))


def test_depth_of_another_size_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=f"{DEPTH}: has 40x24 pixels, but its colour image has 32x24; choose depth registered"
    ):
        load_sequence(str(write_with_other_depth(tmp_path, size=(40, HEIGHT))))


def test_depth_without_common_stamps_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no image on .* is within 0.02 s of an image on"):
        load_sequence(str(write_with_other_depth(tmp_path, stamp=20)))


def test_first_frame_that_is_broken_can_be_skipped(tmp_path: Path) -> None:
    messages = valid_messages(ROS2)
    image = next(message for topic, _, message in messages if topic == RGB)
    image.data = image.data[:10]
    path = ROS2.write(tmp_path / "take", messages)
    with pytest.raises(InputError, match="has less data than its"):
        load_sequence(path)
    sequence = load_sequence(path, skip_broken=True)
    assert isinstance(sequence, BagSequence)
    assert_frame(sequence, 1, 1)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("keep", [0, 60, 0.5])
def test_truncated_bag_is_an_input_error(kind: Kind, keep: float, tmp_path: Path) -> None:
    make = MessageFactory(kind)
    path = make.write(tmp_path / "take", valid_messages(make))
    file = path if kind == "bag" else next(path.glob(f"*.{kind}"))
    content = file.read_bytes()
    file.write_bytes(content[: int(keep * len(content)) if keep < 1 else int(keep)])
    with pytest.raises(InputError, match="is damaged or not a bag") as caught:
        list(load_sequence(str(path)))
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["take", "take.v2", "take.bag"])
def test_damaged_folder_is_repaired_by_the_command_of_ros2(name: str, tmp_path: Path) -> None:
    path = ROS2.write(tmp_path / name, valid_messages(ROS2))
    next(path.glob("*.db3")).write_bytes(b"")
    with pytest.raises(InputError, match=rf"{name}: is damaged or not a bag .*, or repair it with ros2 bag reindex$"):
        load_sequence(str(path))


def test_missing_rosbags_is_an_input_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = ROS2.write(tmp_path / "take", valid_messages(ROS2))
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    with pytest.raises(InputError, match=r"reading a bag needs rosbags .*run pip install rosbags"):
        load_sequence(str(path))


# --- the command


@pytest.mark.usefixtures("undrawn")
def test_run_on_a_bag_of_the_demo_is_accurate(tmp_path: Path) -> None:
    """Run the command on ten frames of the demo as a ROS 1 bag."""
    copy_frames(tmp_path / "folder", range(10))
    folder = load_sequence(str(tmp_path / "folder"))
    make, camera = MessageFactory("bag"), folder.camera
    intrinsics = [camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1]
    messages: list[Message] = [("/kinect/rgb/info", 1.0, make.info(640, 480, intrinsics, [], P))]
    for frame in folder:
        images = ("rgb", "rgb8", as_rgb(frame.image)), ("depth", "32FC1", frame.depth[0].numpy())
        for kind, encoding, pixels in images:
            messages.append((f"/kinect/{kind}/image", frame.stamp, make.image(frame.stamp, encoding, pixels)))
    bag = make.write(tmp_path / "demo", messages)
    arguments = ["--seq", bag, "--info-topic", "/kinect/rgb/info", "--segmenter", "none", "--out", tmp_path / "out"]
    done = call_here(*arguments, cwd=tmp_path)
    assert (done.exit_code, done.stderr) == (0, "")
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert (metrics["sequence"], metrics["frames"], metrics["tracked"]) == ("demo", 10, 10)
    trajectory = read_trajectory(tmp_path / "out" / "trajectory.txt")
    assert trajectory.stamps.tolist() == pytest.approx(folder.stamps.tolist(), abs=1e-6)
    assert folder.groundtruth is not None
    assert evaluate(folder.groundtruth, trajectory).ate.rmse < 0.005
