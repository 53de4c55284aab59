"""ROS 2 messages of a run, frame by frame.

================================  ==========================================  =====================================
``/tf``                           ``tf2_msgs/TFMessage``, every frame         ``map``, ``odom``, ``camera_link``,
                                                                              ``camera_color_optical_frame``
``/odom``                         ``nav_msgs/Odometry``, every frame          pose in ``odom``, velocity, covariances
``/camera/color/camera_info``     ``sensor_msgs/CameraInfo``, every frame
``/objects``                      ``visualization_msgs/MarkerArray``,         box, name and velocity of each object
                                  every frame
``/cloud``                        ``sensor_msgs/PointCloud2``, keyframes      static pixels, in the camera's frame
``/path``                         ``nav_msgs/Path``, keyframes                keyframes; at the end all frames
``/cloud_map``                    ``sensor_msgs/PointCloud2``, at the end     the static map
``/map``                          ``nav_msgs/OccupancyGrid``, at the end      the floor, if an occupancy map is grown
================================  ==========================================  =====================================

While the camera is lost, only ``/camera/color/camera_info`` has messages. While its place in the map is only a guess
(status ``disconnected``), there are also ``/odom`` and the transforms from ``odom`` on, but none from ``map``, so that
navigation in the map stops. The first of these frames also removes the markers of ``/objects``. ``map`` turns against
``odom`` when the floor has shown where up is, at the latest at the end, with one more ``/tf``; a measured gravity is
known at the first frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from v3d_torch.export.ros import frames
from v3d_torch.export.ros.markers import no_markers, object_markers
from v3d_torch.export.ros.messages import camera_info, occupancy_grid, odometry, path, transforms
from v3d_torch.export.ros.point_cloud import point_cloud
from v3d_torch.frame_result import FrameResult
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, transform_points
from v3d_torch.mapping.keyframe import stack_poses
from v3d_torch.objects.frame_objects import FrameObjects
from v3d_torch.reconstruction.point_map import PointMap
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import RGBDFrame, TrackingStatus

_CLOUD_STRIDE = 4
"""Every n-th row and column of a keyframe is in its cloud, so that a bag is small and viewers can show many clouds."""


class Message(Protocol):
    """Message of any type."""

    __msgtype__: ClassVar[str]


_TURN_DELAY = 1e-6
"""Time from the last frame to the transforms of the final map, seconds: tf2 ignores those of a repeated time."""

_MIN_COVARIANCE = 1e-9 * torch.eye(6, dtype=torch.float64)
"""Covariance that is added to that of a pose, metres and radians, a standard deviation of 0.03 mm: the first camera
defines the map, so that its covariance is 0, which filters cannot invert."""

TopicMessage = tuple[str, Message]
"""Topic and message."""


class RunMessages:
    """Makes the ROS 2 messages of a run.

    Args:
        camera: Camera of all frames.

    Attributes:
        stamp: Timestamp of the newest message, seconds; NaN before the first one.
    """

    def __init__(self, camera: PinholeCamera) -> None:
        self.stamp = math.nan
        self._camera = camera
        self._odometry_frame = frames.OdometryFrame()
        self._last: list[int] = []  # positions in the pose history of the last two frames with a pose
        self._T_mw = frames.map_frame(None)  # as at the last frame
        self._has_markers = False

    def of_frame(self, frame: RGBDFrame, objects: FrameObjects, slam: V3DSLAM) -> Iterator[TopicMessage]:
        """Yield the messages of a frame.

        Args:
            frame: Frame.
            objects: Objects of the frame, or its `FrameResult`.
            slam: System after it tracked the frame.

        Raises:
            OutputError: If the timestamp is out of the range of ROS messages.
        """
        self.stamp = stamp = frame.stamp
        yield "/camera/color/camera_info", camera_info(stamp, frames.OPTICAL, self._camera)
        is_localised = slam.poses.is_localised
        if not is_localised and self._has_markers:  # viewers would show them until the camera is found
            yield "/objects", no_markers(stamp)
            self._has_markers = False
        if slam.poses.status is TrackingStatus.LOST:
            return
        self._T_mw = frames.map_frame(slam.T_lw)
        yield from self._pose_messages(stamp, slam)
        if not is_localised:
            return
        yield "/objects", object_markers(stamp, objects, slam.up, self._T_mw)
        self._has_markers = True
        if slam.map.newest_keyframe_at(stamp) is not None:
            yield "/cloud", self._cloud(frame, objects)
            own = slam.map.own_keyframes
            T_ml = frames.camera_in_map(invert(stack_poses(own)), self._T_mw)
            yield "/path", path(stamp, frames.MAP, [each.stamp for each in own], T_ml)

    def of_end(self, slam: V3DSLAM, point_map: PointMap) -> Iterator[TopicMessage]:
        """Yield the messages of the final state at the time of the last frame; none if the camera was never found.

        If up has become known or more accurate since that frame, ``map`` is turned a microsecond later.

        Args:
            slam: System after at least one frame.
            point_map: Map of the static scene.
        """
        if not slam.poses.was_found:
            return
        self.stamp, trajectory, T_mw = slam.poses.stamp, slam.poses.trajectory(), frames.map_frame(slam.T_lw)
        if not torch.equal(T_mw, self._T_mw):
            self.stamp, self._T_mw = self.stamp + _TURN_DELAY, T_mw
            newest = self._last[-1] if self._last else len(slam.poses) - 1
            T_ml = frames.camera_in_map(invert(slam.poses.poses_of([newest])[0]), T_mw)
            self._odometry_frame.turn_map(T_ml)
            is_lost = slam.poses.status is TrackingStatus.LOST
            yield "/tf", self._tree(self.stamp, is_localised=is_lost or slam.poses.is_localised, is_lost=is_lost)
        yield (
            "/path",
            path(self.stamp, frames.MAP, trajectory.stamps.tolist(), frames.camera_in_map(trajectory.T_wc, T_mw)),
        )
        points = frames.points_in_map(point_map.points, T_mw)
        yield "/cloud_map", point_cloud(self.stamp, frames.MAP, points, point_map.colours)
        yield from self._grid(self.stamp, slam)

    def of_grid(self, slam: V3DSLAM) -> Iterator[TopicMessage]:
        """Yield the occupancy grid, if there is one: it takes 0.1 s in a room, and seconds in a map of 20 m.

        Another thread can call this while frames are tracked.

        Args:
            slam: System after at least one frame.
        """
        yield from self._grid(slam.poses.stamp, slam)

    def _grid(self, stamp: float, slam: V3DSLAM) -> Iterator[TopicMessage]:
        if slam.occupancy is not None and (grid := slam.occupancy.grid()) is not None:
            yield "/map", occupancy_grid(stamp, frames.MAP, grid, self._T_mw)

    def _pose_messages(self, stamp: float, slam: V3DSLAM) -> Iterator[TopicMessage]:
        odometry_frame, state = self._odometry_frame, slam.states.at(stamp)
        newest = len(slam.poses) - 1
        known = [*self._last, newest]
        T_cw = slam.poses.poses_of([known[0]] * (3 - len(known)) + known)  # the first also stands for those before it
        odometry_frame.update(*frames.camera_in_map(invert(T_cw), self._T_mw))
        self._last = known[-2:]
        yield "/tf", self._tree(stamp, is_localised=slam.poses.is_localised)
        to_link = _rotate_both_halves(frames.T_LINK_OPTICAL)
        to_odom = _rotate_both_halves(odometry_frame.T_ol @ frames.T_LINK_OPTICAL)
        yield (
            "/odom",
            odometry(
                stamp,
                (frames.ODOM, frames.CAMERA),
                odometry_frame.T_ol,
                to_link @ state.twist,
                pose_covariance=to_odom @ state.covariance @ to_odom.T + _MIN_COVARIANCE,
                twist_covariance=to_link @ state.twist_covariance @ to_link.T,
            ),
        )

    def _tree(self, stamp: float, *, is_localised: bool, is_lost: bool = False) -> Message:
        """Make the transforms of the newest pose: from ``map`` if its place is known, to the camera if its pose is."""
        tree = {(frames.MAP, frames.ODOM): self._odometry_frame.T_mo} if is_localised else {}
        if not is_lost:
            tree[frames.ODOM, frames.CAMERA] = self._odometry_frame.T_ol
            tree[frames.CAMERA, frames.OPTICAL] = frames.T_LINK_OPTICAL  # every time: a replay can start later
        return transforms(stamp, tree)

    def _cloud(self, frame: RGBDFrame, objects: FrameObjects) -> Message:
        """Make the cloud of the static pixels at the time of the colour image, which the stamp of the frame is."""
        step = slice(None, None, _CLOUD_STRIDE)
        keep = objects.map_mask[step, step] & (frame.depth[0, step, step] > 0)
        points = self._camera.rays[step, step][keep] * frame.depth[0, step, step][keep][:, None]
        if isinstance(objects, FrameResult):
            points = transform_points(invert(objects.T_dc), points)
        return point_cloud(frame.stamp, frames.OPTICAL, points, frame.image[:, step, step].permute(1, 2, 0)[keep])


def _rotate_both_halves(T: Tensor) -> Tensor:
    """Matrix that rotates translation and rotation of a twist or an error by a transform, float64, shape (6, 6)."""
    return torch.block_diag(T[:3, :3], T[:3, :3])
