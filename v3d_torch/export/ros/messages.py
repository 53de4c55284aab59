"""ROS 2 messages of poses, cameras and occupancy grids, made from tensors.

The definitions are those of ROS 2 Humble. Later distributions differ from them in additional constants only.
"""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal

import numpy as np
import torch
from numpy.typing import NDArray
from rosbags.typesys.stores import ros2_humble as ros
from scipy.spatial.transform import Rotation
from torch import Tensor

from v3d_torch.errors import OutputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert
from v3d_torch.occupancy.occupancy_grid import OccupancyGrid
from v3d_torch.occupancy.occupancy_map import VoxelState

_NANOSECONDS = 10**9

_MAX_SECONDS = 2**31
"""Maximum time of ROS: seconds are signed 32-bit integers."""

_OCCUPANCY = {VoxelState.UNKNOWN: -1, VoxelState.FREE: 0, VoxelState.OCCUPIED: 100}
"""Values of cells, as `nav_msgs/OccupancyGrid` defines them: the probability in per cent, or unknown."""


def nanoseconds(stamp: float) -> int:
    """Convert a timestamp to whole nanoseconds, from which `BagSequence` reads the same timestamp.

    A time of today has steps of 238 ns in float64. Of the times that are rounded to the timestamp, the one with the
    fewest digits is taken: that of the camera if its clock counts microseconds.

    Args:
        stamp: Timestamp, seconds.

    Raises:
        OutputError: If the time is out of the range of ROS messages.
    """
    if not 0 <= stamp < _MAX_SECONDS:
        raise OutputError(f"timestamp {stamp:.6f} s: ROS messages have times from 0 to 2^31 s; shift the timestamps")
    return round(Decimal(repr(float(stamp))) * _NANOSECONDS)  # the product of floats has steps of 256 ns


def header(stamp: float, frame: str) -> ros.std_msgs__msg__Header:
    """Make a header.

    Args:
        stamp: Timestamp, seconds.
        frame: Name of the coordinate frame of the data.

    Raises:
        OutputError: As `nanoseconds`. All functions with a timestamp can raise it.
    """
    return ros.std_msgs__msg__Header(
        ros.builtin_interfaces__msg__Time(*divmod(nanoseconds(stamp), _NANOSECONDS)), frame
    )


def point(position: Tensor) -> ros.geometry_msgs__msg__Point:
    """Make a point from a position, metres, shape :math:`(3,)`."""
    return ros.geometry_msgs__msg__Point(*position.tolist())


def vector(components: Tensor) -> ros.geometry_msgs__msg__Vector3:
    """Make a vector from its components, shape :math:`(3,)`."""
    return ros.geometry_msgs__msg__Vector3(*components.tolist())


def pose(T: Tensor) -> ros.geometry_msgs__msg__Pose:
    """Make a pose from a transform, shape :math:`(4, 4)`, to the frame of the header."""
    return _poses(T[None])[0]


def transforms(stamp: float, T: dict[tuple[str, str], Tensor]) -> ros.tf2_msgs__msg__TFMessage:
    """Make the transforms of one time, for the topic ``/tf``.

    Args:
        stamp: Timestamp, seconds.
        T: Transform from the child to the parent frame, float64, shape :math:`(4, 4)`, by (parent, child).
    """
    stamped = [
        ros.geometry_msgs__msg__TransformStamped(
            header(stamp, parent),
            child,
            ros.geometry_msgs__msg__Transform(vector(T_pc[:3, 3]), pose(T_pc).orientation),
        )
        for (parent, child), T_pc in T.items()
    ]
    return ros.tf2_msgs__msg__TFMessage(stamped)


def odometry(
    stamp: float,
    frames: tuple[str, str],
    T_pc: Tensor,
    twist: Tensor,
    pose_covariance: Tensor,
    twist_covariance: Tensor,
) -> ros.nav_msgs__msg__Odometry:
    """Make an odometry message.

    Args:
        stamp: Timestamp, seconds.
        frames: Names of the parent and the child frame.
        T_pc: Pose of the child frame in the parent frame, float64, shape :math:`(4, 4)`.
        twist: Velocity of the child frame, in the child frame: linear (m/s) and angular (rad/s), float64, shape
            :math:`(6,)`.
        pose_covariance: Covariance of position and of rotation about the axes of the parent frame, in this order,
            metres and radians, shape :math:`(6, 6)`. `RunMessages` gives that of the pose in ``map``, which does not
            contain the drift of ``odom``.
        twist_covariance: Covariance of the twist, shape :math:`(6, 6)`.
    """
    velocity = ros.geometry_msgs__msg__Twist(vector(twist[:3]), vector(twist[3:]))
    return ros.nav_msgs__msg__Odometry(
        header(stamp, frames[0]),
        frames[1],
        ros.geometry_msgs__msg__PoseWithCovariance(pose(T_pc), _flatten(pose_covariance)),
        ros.geometry_msgs__msg__TwistWithCovariance(velocity, _flatten(twist_covariance)),
    )


def path(stamp: float, frame: str, stamps: Sequence[float], T: Tensor) -> ros.nav_msgs__msg__Path:
    """Make a path.

    Args:
        stamp: Timestamp of the message, seconds.
        frame: Name of the coordinate frame of the poses.
        stamps: Timestamps of the poses, seconds.
        T: Poses in the frame, float64, shape :math:`(N, 4, 4)`.
    """
    poses = [
        ros.geometry_msgs__msg__PoseStamped(header(pose_stamp, frame), each)
        for pose_stamp, each in zip(stamps, _poses(T), strict=True)
    ]
    return ros.nav_msgs__msg__Path(header(stamp, frame), poses)


def camera_info(stamp: float, frame: str, camera: PinholeCamera) -> ros.sensor_msgs__msg__CameraInfo:
    """Make the description of a camera.

    Args:
        stamp: Timestamp, seconds.
        frame: Name of the optical frame of the camera.
        camera: Camera.
    """
    K = camera.K
    P = torch.cat([K, torch.zeros(3, 1, dtype=K.dtype)], dim=1)
    return ros.sensor_msgs__msg__CameraInfo(
        header(stamp, frame),
        camera.height,
        camera.width,
        camera.distortion_model,
        np.array(camera.distortion),
        _flatten(K),
        np.eye(3).reshape(-1),
        _flatten(P),
        0,
        0,
        ros.sensor_msgs__msg__RegionOfInterest(0, 0, 0, 0, do_rectify=False),
    )


def occupancy_grid(stamp: float, frame: str, grid: OccupancyGrid, T_fw: Tensor) -> ros.nav_msgs__msg__OccupancyGrid:
    """Make an occupancy grid. It is level even if the frame is not: its origin is rotated in the frame.

    Args:
        stamp: Timestamp, seconds.
        frame: Name of the coordinate frame in which the pose of the grid is given.
        grid: Grid.
        T_fw: Transform from the world frame to the coordinate frame, float64, shape :math:`(4, 4)`.
    """
    T_lg = torch.eye(4, dtype=torch.float64)
    T_lg[:3, 3] = torch.tensor([*grid.origin, grid.height], dtype=torch.float64)
    height, width = grid.states.shape
    values = torch.tensor([_OCCUPANCY[state] for state in VoxelState], dtype=torch.int8)
    return ros.nav_msgs__msg__OccupancyGrid(
        header(stamp, frame),
        ros.nav_msgs__msg__MapMetaData(
            header(stamp, frame).stamp, grid.cell_size, width, height, pose(T_fw @ invert(grid.T_lw) @ T_lg)
        ),
        values[grid.states.to(torch.int64).flatten() + 1].numpy(),
    )


def _poses(T: Tensor) -> list[ros.geometry_msgs__msg__Pose]:
    """Make poses (N, 4, 4) together: a call of scipy takes as long for one as for a hundred."""
    quaternions = Rotation.from_matrix(T[:, :3, :3].numpy()).as_quat(canonical=True).tolist()
    return [
        ros.geometry_msgs__msg__Pose(
            ros.geometry_msgs__msg__Point(*position), ros.geometry_msgs__msg__Quaternion(*quaternion)
        )
        for position, quaternion in zip(T[:, :3, 3].tolist(), quaternions, strict=True)
    ]


def _flatten(matrix: Tensor) -> NDArray[np.float64]:
    """Return the elements of a matrix, row by row."""
    return matrix.reshape(-1).to(torch.float64).numpy()
