"""Messages of poses and cameras: values, conventions, and definitions of all ROS 2 distributions."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.bag_messages import matrix_of
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from v3d_torch.errors import OutputError
from v3d_torch.export.ros.messages import (
    camera_info,
    header,
    nanoseconds,
    occupancy_grid,
    odometry,
    path,
    pose,
    transforms,
)
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.occupancy.occupancy_grid import OccupancyGrid

T = se3_exp(torch.tensor([[0.5, -0.3, 1.0, 0.4, -1.2, 2.0], [0.1, 0, 0, 0, 0, 3.1]], dtype=torch.float64))
TYPES = (
    *("tf2_msgs/msg/TFMessage", "nav_msgs/msg/Odometry", "nav_msgs/msg/Path", "sensor_msgs/msg/CameraInfo"),
    *("nav_msgs/msg/OccupancyGrid", "sensor_msgs/msg/PointCloud2", "visualization_msgs/msg/MarkerArray"),
)
NEWER = [store for store in Stores if store.name.startswith("ROS2_") and store.name > "ROS2_HUMBLE"]


def round_trip(message: Any) -> Any:
    store = get_typestore(Stores.ROS2_HUMBLE)
    return store.deserialize_cdr(store.serialize_cdr(message, message.__msgtype__), message.__msgtype__)


@pytest.mark.parametrize("kind", TYPES)
def test_fields_are_the_same_in_all_distributions_since_humble(kind: str) -> None:
    humble, *newer = (
        get_typestore(store).generate_msgdef(kind, ros_version=2)[0] for store in (Stores.ROS2_HUMBLE, *NEWER)
    )
    assert len(newer) >= 3
    for definition in newer:
        assert [line for line in definition.splitlines() if "=" not in line or line.startswith("=")] == [
            line for line in humble.splitlines() if "=" not in line or line.startswith("=")
        ]


def test_header_has_seconds_and_nanoseconds() -> None:
    message = round_trip(header(1311868164.363181, "map"))
    assert (message.stamp.sec, message.frame_id) == (1311868164, "map")
    assert abs(message.stamp.nanosec - 363181000) < 300  # a float64 has no more digits
    assert (round_trip(header(1.9999999999, "")).stamp.sec, header(0.0, "").stamp.nanosec) == (2, 0)


@given(stamp=st.floats(2**23, 2**31, exclude_max=True))
def test_time_of_a_header_is_read_as_the_same_timestamp(stamp: float) -> None:
    time = header(stamp, "").stamp
    assert time.sec + time.nanosec * 1e-9 == stamp


@given(microseconds=st.integers(0, 2**31 * 10**6 - 1))
def test_time_in_microseconds_is_exact(microseconds: int) -> None:
    assert nanoseconds(microseconds / 10**6) == 1000 * microseconds


@pytest.mark.parametrize("stamp", [-0.1, 2.0**31, np.nan, np.inf])
def test_time_that_ros_cannot_hold_is_error(stamp: float) -> None:
    with pytest.raises(OutputError, match="ROS messages have times from 0 to 2\\^31 s"):
        header(stamp, "map")


def test_transforms_and_path_have_the_given_poses() -> None:
    tf = round_trip(transforms(2.5, {("map", "odom"): T[0], ("odom", "camera_link"): T[1]}))
    assert [(each.header.frame_id, each.child_frame_id) for each in tf.transforms] == [
        ("map", "odom"),
        ("odom", "camera_link"),
    ]
    np.testing.assert_allclose([matrix_of(each.transform) for each in tf.transforms], T, atol=1e-12)
    line = round_trip(path(2.5, "map", [1.0, 2.0], T))
    assert [each.header.stamp.sec for each in line.poses] == [1, 2]
    assert {line.header.frame_id, *(each.header.frame_id for each in line.poses)} == {"map"}
    np.testing.assert_allclose([matrix_of(each.pose) for each in line.poses], T, atol=1e-12)


def test_quaternions_of_a_path_are_computed_together(monkeypatch: pytest.MonkeyPatch) -> None:
    many = se3_exp(torch.randn(50, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    expected, shapes, from_matrix = [pose(each) for each in many], [], Rotation.from_matrix

    def recorded(matrix: NDArray[np.float64]) -> Rotation:
        shapes.append(matrix.shape)
        return from_matrix(matrix)

    monkeypatch.setattr("v3d_torch.export.ros.messages.Rotation", SimpleNamespace(from_matrix=recorded))
    assert [each.pose for each in path(2.5, "map", [1.0] * 50, many).poses] == expected
    assert shapes == [(50, 3, 3)]


def test_occupancy_grid_has_its_cells_row_by_row_and_the_pose_of_the_corner_of_the_first_one() -> None:
    states = torch.tensor([[-1, 0, 1], [0, 0, 1]], dtype=torch.int8)
    grid = OccupancyGrid(states, cell_size=0.05, origin=(-1.0, 2.0), T_lw=T[0], height=-1.3)
    message = round_trip(occupancy_grid(2.5, "map", grid, T[1]))
    assert (message.header.frame_id, message.info.width, message.info.height) == ("map", 3, 2)
    assert message.data.tolist() == [-1, 0, 100, 0, 0, 100] and message.info.resolution == np.float32(0.05)
    corner = T[1] @ torch.linalg.inv(T[0]) @ torch.tensor([-1.0, 2.0, -1.3, 1.0], dtype=torch.float64)
    pose = matrix_of(message.info.origin)
    np.testing.assert_allclose(pose[:3, 3], corner[:3], atol=1e-12)
    np.testing.assert_allclose(pose[:3, :3], (T[1] @ torch.linalg.inv(T[0]))[:3, :3], atol=1e-12)


def test_odometry_has_pose_twist_and_covariance_row_by_row() -> None:
    covariance = torch.arange(36.0).reshape(6, 6)
    twist = torch.arange(1.0, 7.0, dtype=torch.float64)
    message = round_trip(odometry(2.5, ("odom", "camera_link"), T[0], twist, covariance, covariance.T))
    assert (message.header.frame_id, message.child_frame_id) == ("odom", "camera_link")
    np.testing.assert_allclose(matrix_of(message.pose.pose), T[0], atol=1e-12)
    linear, angular = message.twist.twist.linear, message.twist.twist.angular
    assert [linear.x, linear.y, linear.z, angular.x, angular.y, angular.z] == [1, 2, 3, 4, 5, 6]
    assert message.pose.covariance.tolist() == list(range(36))
    assert np.reshape(message.twist.covariance, (6, 6)).T.flatten().tolist() == list(range(36))


def test_convention_camera_info_has_opencv_matrix_and_distortion() -> None:
    camera = PinholeCamera(517.3, 516.5, 318.6, 255.3, 640, 480, (0.26, -0.95, -0.005, 0.003, 1.16))
    message = round_trip(camera_info(2.5, "optical", camera))
    assert (message.width, message.height, message.distortion_model) == (640, 480, "plumb_bob")
    assert message.d.tolist() == [0.26, -0.95, -0.005, 0.003, 1.16]  # k1 k2 p1 p2 k3
    assert message.k.tolist() == [517.3, 0, 318.6, 0, 516.5, 255.3, 0, 0, 1]
    assert message.p.tolist() == [517.3, 0, 318.6, 0, 0, 516.5, 255.3, 0, 0, 0, 1, 0]
    assert message.r.tolist() == [1, 0, 0, 0, 1, 0, 0, 0, 1]


def test_camera_info_names_the_distortion_model_of_the_camera() -> None:
    camera = PinholeCamera(285.0, 286.0, 318.6, 255.3, 640, 480, (0.1, 0.2, 0.3, 0.4), distortion_model="equidistant")
    message = round_trip(camera_info(2.5, "optical", camera))
    assert (message.distortion_model, message.d.tolist()) == ("equidistant", [0.1, 0.2, 0.3, 0.4])
