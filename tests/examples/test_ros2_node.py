"""The ROS 2 node with stand-ins for the modules of ROS, on images along the wall."""

from __future__ import annotations

import runpy
import sys
from array import array
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
import torch
from helpers.bag_messages import matrix_of
from helpers.bags import MessageFactory
from helpers.fake_ros import FakeROS, Pair
from helpers.short_wall import CAMERA, FRAMES, STEP, WALL, Wall
from helpers.waiting import wait_until
from rosbags.typesys import Stores, get_typestore

from v3d_torch.export.ros.frames import map_frame
from v3d_torch.occupancy.occupancy_grid import OccupancyGrid
from v3d_torch.occupancy.occupancy_mapper import OccupancyMapper

TIMES = [1_700_000_005 * 10**9 + index * 10**8 + 37 * index for index in range(FRAMES)]
"""Times of the images, nanoseconds."""
NODE = Path(__file__).parents[2] / "examples" / "ros2_node.py"


def images(node: Any) -> Iterator[Pair]:
    """Yield the images along the wall, each after the one before was tracked, as the real messages hold them."""
    factory, wall = MessageFactory("mcap"), Wall()
    for index in range(FRAMES):
        frame = wall[index]
        colour = factory.image(0, "rgb8", frame.image.permute(1, 2, 0).numpy())
        depth = factory.image(0, "16UC1", np.full((240, 320), 1000 * WALL, np.uint16))
        for message, time_of_image in ((colour, TIMES[index]), (depth, TIMES[index] + 10**7)):
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(time_of_image, 10**9)
            object.__setattr__(message, "data", array("B", message.data.tobytes()))
        yield colour, depth
        wait_until(lambda: len(node.slam.poses) > index, 60, f"image {index} was tracked")  # noqa: B023 - called here


def make_ros(
    images: Callable[[Any], Iterator[Pair]], *, d: list[float] = 5 * [0.0], model: str = "plumb_bob"
) -> FakeROS:
    """ROS with the camera of the wall and some images."""
    k = [CAMERA.fx, 0, CAMERA.cx, 0, CAMERA.fy, CAMERA.cy, 0, 0, 1]
    info = MessageFactory("mcap").info(CAMERA.width, CAMERA.height, k, d, [0.0] * 12, model)
    settings = ["segmentation.source=none", "mapping.max_keyframe_interval=5", "occupancy.enabled=true"]
    return FakeROS(info, images, {"set": settings})


def run_node(ros: FakeROS) -> None:
    """Run the node until its images end."""
    with pytest.MonkeyPatch.context() as patch:
        for name, module in ros.modules().items():
            patch.setitem(sys.modules, name, module)
        example = runpy.run_path(str(NODE))
        example["main"].__globals__["GRID_INTERVAL"] = FRAMES
        cells = OccupancyGrid(torch.zeros(3, 4, dtype=torch.int8), 0.05, (0.0, 0.0), map_frame(None), -1.2)
        patch.setattr(OccupancyMapper, "grid", lambda self: cells)  # a wall has no floor
        example["main"]()


@pytest.fixture(scope="module")
def ros() -> FakeROS:
    """ROS after the node has run."""
    ros = make_ros(images)
    run_node(ros)
    return ros


def test_node_subscribes_to_colour_and_aligned_depth(ros: FakeROS) -> None:
    assert ros.subscribed == ["camera/color/image_raw", "camera/aligned_depth_to_color/image_raw"]


def test_node_publishes_poses_path_and_clouds_in_the_types_of_ros(ros: FakeROS) -> None:
    kinds = {topic: {kind for kind, _ in messages} for topic, messages in ros.published.items()}
    assert kinds == {
        "/tf": {"tf2_msgs/msg/TFMessage"},
        "/odom": {"nav_msgs/msg/Odometry"},
        "/objects": {"visualization_msgs/msg/MarkerArray"},
        "/cloud": {"sensor_msgs/msg/PointCloud2"},
        "/path": {"nav_msgs/msg/Path"},
        "/map": {"nav_msgs/msg/OccupancyGrid"},
    }
    assert len(ros.published["/tf"]) == len(ros.published["/odom"]) == FRAMES
    assert len(ros.published["/map"]) == 1
    assert len(ros.published["/path"]) == len(ros.published["/cloud"]) >= 2


def test_map_is_kept_for_nodes_that_subscribe_later(ros: FakeROS) -> None:
    """The map server of nav2 publishes so, and the costmaps of nav2 receive the map of no other publisher."""
    assert ros.qos.pop("/map") == {"depth": 1, "durability": "transient local"}
    assert set(ros.qos.values()) == {10}


def test_odometry_follows_the_camera_to_the_right(ros: FakeROS) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    poses = [store.deserialize_cdr(message, kind) for kind, message in ros.published["/odom"]]
    right = [-matrix_of(pose.pose.pose)[1, 3] for pose in poses]  # y points left
    np.testing.assert_allclose(right, np.arange(FRAMES) * STEP * WALL / CAMERA.fx, atol=0.02)


def test_poses_are_known_at_the_times_of_their_images(ros: FakeROS) -> None:
    """A pose that is a little earlier is of no use to tf2: it waits for the next one."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    stamps = [store.deserialize_cdr(message, kind).header.stamp for kind, message in ros.published["/odom"]]
    late = [stamp.sec * 10**9 + stamp.nanosec - time for stamp, time in zip(stamps, TIMES, strict=True)]
    assert min(late) >= 0 and max(late) < 1000


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_node_skips_unreadable_images_and_ends_when_spinning_fails() -> None:
    factory = MessageFactory("mcap")

    def failing(node: Any) -> Iterator[Pair]:
        for index, (colour, depth) in enumerate(islice(images(node), 2)):
            yield factory.image(5 + index / 10, "bayer", np.zeros((240, 320), np.uint8)), depth
            yield colour, depth
        raise RuntimeError("the connection is lost")

    ros = make_ros(failing)
    thread = Thread(target=run_node, args=(ros,), daemon=True)
    thread.start()
    thread.join(30)
    assert not thread.is_alive()
    assert len(ros.published["/odom"]) == 2
    assert len(ros.warnings) == 2 and "a frame is skipped: camera/color/image_raw: " in ros.warnings[0]


@pytest.mark.parametrize("model", ["", "none", "radtan"])
def test_camera_without_distortion_can_have_any_model(model: str) -> None:
    ros = make_ros(lambda node: islice(images(node), 2), d=[], model=model)
    run_node(ros)
    assert len(ros.published["/odom"]) == 2


def test_node_is_shorter_than_a_hundred_lines() -> None:
    assert len(NODE.read_text().splitlines()) < 100
