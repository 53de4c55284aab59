"""Stand-ins for the modules of ROS 2 that a node imports: topics are lists, and spinning calls the callbacks."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from types import ModuleType, SimpleNamespace
from typing import Any

Pair = tuple[Any, Any]
"""Messages of a colour and a depth image."""


class FakeROS:
    """ROS with one camera.

    Args:
        info: Message that ``wait_for_message`` returns.
        images: Pairs of images that ``spin`` gives to the synchroniser of the node.
        parameters: Values of the parameters of the node.

    Attributes:
        published: Type and serialised messages of each topic.
        qos: Quality of service of each published topic, or the depth of its queue.
        subscribed: Topics of the images.
        warnings: Warnings of the node.
    """

    def __init__(self, info: Any, images: Callable[[Any], Iterable[Pair]], parameters: dict[str, Any]) -> None:
        self.published: dict[str, list[tuple[str, bytes]]] = defaultdict(list)
        self.qos: dict[str, Any] = {}
        self.subscribed: list[str] = []
        self.warnings: list[str] = []
        self._info, self._images, self._parameters = info, images, parameters
        self._callback: Callable[[Any, Any], None] | None = None

    def modules(self) -> dict[str, ModuleType]:
        """The modules, by name."""
        ros = self

        class Node:
            def __init__(self, name: str) -> None:
                assert name

            def declare_parameter(self, name: str, default: Any) -> Any:
                class Parameter:
                    value = ros._parameters.get(name, default)

                return Parameter

            def get_logger(self) -> Any:
                class Logger:
                    warning = ros.warnings.append

                return Logger

            def create_publisher(self, kind: str, topic: str, qos: Any) -> Any:
                ros.qos[topic] = qos

                class Publisher:
                    def publish(self, message: bytes) -> None:
                        assert isinstance(message, bytes)
                        ros.published[topic].append((kind, message))

                return Publisher()

        class Synchronizer:
            def __init__(self, subscribers: list[str], queue_size: int, slop: float) -> None:
                assert len(subscribers) == 2 and queue_size > 0 and slop > 0

            def registerCallback(self, callback: Callable[[Any, Any], None]) -> None:
                ros._callback = callback

        def subscriber(node: Node, kind: type, topic: str, qos_profile: object) -> str:
            ros.subscribed.append(topic)
            return topic

        def spin(node: Node) -> None:
            assert ros._callback is not None
            for colour, depth in ros._images(node):
                ros._callback(colour, depth)

        contents: dict[str, dict[str, Any]] = {
            "rclpy": {"init": lambda: None, "spin": spin},
            "rclpy.node": {"Node": Node},
            "rclpy.qos": {
                "DurabilityPolicy": SimpleNamespace(TRANSIENT_LOCAL="transient local"),
                "QoSProfile": dict,
                "qos_profile_sensor_data": object(),
            },
            "rclpy.wait_for_message": {"wait_for_message": lambda kind, node, topic: (True, self._info)},
            "message_filters": {"Subscriber": subscriber, "ApproximateTimeSynchronizer": Synchronizer},
            "rosidl_runtime_py": {},
            "rosidl_runtime_py.utilities": {"get_message": lambda name: name},
            "sensor_msgs": {},
            "sensor_msgs.msg": {"CameraInfo": type("CameraInfo", (), {}), "Image": type("Image", (), {})},
        }
        modules = {}
        for name, content in contents.items():
            modules[name] = ModuleType(name)
            vars(modules[name]).update(content)
        return modules
