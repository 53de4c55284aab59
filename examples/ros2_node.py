"""ROS 2 node: `LiveSLAM` on the topics of an RGB-D camera; publishes poses, static clouds and a grid for planners.

``python examples/ros2_node.py`` subscribes to ``camera/color/image_raw``, ``camera/color/camera_info`` and
``camera/aligned_depth_to_color/image_raw``; other names are given by ``--ros-args -r OLD:=NEW``. It publishes ``/tf``,
``/odom``, ``/objects``, ``/cloud``, ``/path`` and, every few seconds, ``/map``. The driver should publish no transforms
(``publish_tf:=false``). Parameters: ``config``, a configuration; ``set``, values, default ``occupancy.enabled=true``.
It has not been tried with an installed ROS: the tests run it with stand-ins for the modules of ROS.
"""

from __future__ import annotations

import gc
import itertools
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from queue import SimpleQueue
from threading import Thread

import rclpy
import torch
from message_filters import ApproximateTimeSynchronizer, Subscriber
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.wait_for_message import wait_for_message
from rosbags.typesys import Stores, get_typestore
from rosidl_runtime_py.utilities import get_message
from sensor_msgs.msg import CameraInfo, Image

import v3d_torch as v3d
from v3d_torch.datasets.ros.bag_images import decode_colour_message, decode_depth_message
from v3d_torch.datasets.ros.camera_info import camera_from_info
from v3d_torch.export.ros.run_messages import RunMessages, TopicMessage

COLOUR, DEPTH, INFO = "camera/color/image_raw", "camera/aligned_depth_to_color/image_raw", "camera/color/camera_info"
GRID_INTERVAL = 200  # tracked frames between two grids: that of a large map takes seconds, in a thread of its own
QOS = {"/map": QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)}  # as nav2 subscribes to it


class SlamNode(Node):
    """Puts the images of the camera into a queue, and publishes the results of a system."""

    def __init__(self) -> None:
        super().__init__("v3d_slam")
        config = self.declare_parameter("config", "realtime").value
        overrides = self.declare_parameter("set", ["occupancy.enabled=true"]).value
        camera = camera_from_info(wait_for_message(CameraInfo, self, INFO)[1], INFO)
        self.slam = v3d.V3DSLAM(camera, config=v3d.load_config(config, overrides))
        self.frames: SimpleQueue[v3d.RGBDFrame | None] = SimpleQueue()
        self._messages, self._store = RunMessages(camera), get_typestore(Stores.ROS2_HUMBLE)
        self._indices, self._topics, self.worker = itertools.count(), {}, ThreadPoolExecutor(1)
        subscribers = [Subscriber(self, Image, name, qos_profile=qos_profile_sensor_data) for name in (COLOUR, DEPTH)]
        self._images = ApproximateTimeSynchronizer(subscribers, queue_size=5, slop=0.02)
        self._images.registerCallback(self._add_frame)

    def receive(self) -> None:
        """Receive images until ROS is shut down; then the frames end, also if ``rclpy.spin`` raises an exception."""
        try:
            rclpy.spin(self)
        finally:
            self.frames.put(None)

    def publish_result(self, result: v3d.LiveResult) -> None:
        """Publish the messages of a tracked frame, and sometimes the grid."""
        self._publish([*self._messages.of_frame(result.frame, result, self.slam)])
        if len(self.slam.poses) % GRID_INTERVAL == 0:
            published = self.worker.submit(lambda: self._publish([*self._messages.of_grid(self.slam)]))
            published.add_done_callback(Future.result)  # logs the error, if there was one

    def _add_frame(self, colour: Image, depth: Image) -> None:
        time, depth_time = (each.header.stamp.sec + 1e-9 * each.header.stamp.nanosec for each in (colour, depth))
        try:
            images = decode_colour_message(colour, COLOUR).permute(1, 2, 0), decode_depth_message(depth, DEPTH)
            stamp = time + 3e-7  # never rounded to before the image, so that tf2 finds its pose without waiting
            arguments = next(self._indices), stamp, *images, self.slam.camera
            self.frames.put(v3d.RGBDFrame.from_arrays(*arguments, depth_delay=depth_time - time))
        except v3d.InputError as error:
            self.get_logger().warning(f"a frame is skipped: {error}")

    def _publish(self, messages: list[TopicMessage]) -> None:
        for topic, message in messages:
            if topic not in self._topics and not topic.endswith("camera_info"):  # which the driver publishes
                self._topics[topic] = self.create_publisher(get_message(message.__msgtype__), topic, QOS.get(topic, 10))
            if topic in self._topics:
                self._topics[topic].publish(bytes(self._store.serialize_cdr(message, message.__msgtype__)))


def main() -> None:
    """Run until ROS is shut down, for example by Ctrl-C."""
    gc.freeze()  # later searches for garbage leave out the objects of the imports, which would take 0.2 s
    rclpy.init()
    torch.set_num_threads(1)  # more threads mostly wait for each other
    node = SlamNode()
    Thread(target=node.receive, daemon=True).start()
    with suppress(KeyboardInterrupt), node.worker:
        v3d.LiveSLAM(iter(node.frames.get, None), node.slam)(node.publish_result)


if __name__ == "__main__":
    main()
