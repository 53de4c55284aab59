"""ROS 2 markers of the objects of a frame: box, name and velocity, in the colour of the motion state."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from matplotlib.colors import to_rgb
from rosbags.typesys.stores import ros2_humble as ros
from torch import Tensor

from v3d_torch.export.ros.frames import MAP, points_in_map
from v3d_torch.export.ros.messages import header, point, pose, vector
from v3d_torch.objects.frame_objects import FrameObjects, MotionState, TrackedObject
from v3d_torch.objects.upright_box import UprightBox
from v3d_torch.viz.object_overlay import MOTION_STATE_COLOURS

Marker = ros.visualization_msgs__msg__Marker

_BOX_OPACITY = 0.4

_NAME_HEIGHT = 0.15
"""Height of a letter, metres."""

_ARROW = (0.03, 0.06, 0.1)
"""Diameter of the shaft, diameter and length of the head of an arrow, metres."""

_MIN_SIZE = 0.02
"""Smallest side of a box, metres: viewers reject boxes without volume."""

_IDENTITY, _UNIT = torch.eye(4, dtype=torch.float64), torch.ones(3)


def no_markers(stamp: float) -> ros.visualization_msgs__msg__MarkerArray:
    """Make the message that removes all markers.

    Args:
        stamp: Timestamp, seconds.
    """
    return _marker_array([_removal(stamp)])


def object_markers(
    stamp: float, objects: FrameObjects, up: Tensor, T_mw: Tensor
) -> ros.visualization_msgs__msg__MarkerArray:
    """Make the markers of a frame, in ``map``. The first marker removes the markers of the previous frame.

    A dynamic object has an arrow, which ends where the object will be one second later. Objects without a centroid or
    a cloud have no markers.

    Args:
        stamp: Timestamp, seconds.
        objects: Objects of the frame.
        up: Direction against gravity, world frame, shape :math:`(3,)`.
        T_mw: Transform from the world frame to ``map``, float64, shape :math:`(4, 4)`.
    """
    markers = [_removal(stamp)]
    boxes = objects.boxes(up)
    for each in objects.objects:
        if each.id in boxes:
            markers += _box_and_name(stamp, each, boxes[each.id], T_mw)
            if each.motion_state is MotionState.DYNAMIC:
                markers.append(_arrow(stamp, each, T_mw))
    return _marker_array(markers)


def _marker_array(markers: list[Marker]) -> ros.visualization_msgs__msg__MarkerArray:
    return ros.visualization_msgs__msg__MarkerArray(markers)  # type: ignore[arg-type]  # rosbags annotates an old Marker


def _removal(stamp: float) -> Marker:
    """Marker that removes all markers before it."""
    return _marker(stamp, "", 0, Marker.CUBE, "unknown", action=Marker.DELETEALL)


def _box_and_name(stamp: float, each: TrackedObject, box: UprightBox, T_mw: Tensor) -> list[Marker]:
    state = each.motion_state.value
    T_mb, size = T_mw @ box.T_wb, box.size.clamp(min=_MIN_SIZE)
    above = T_mb.clone()
    above[:3, 3] += T_mb[:3, 2] * (size[2] / 2 + _NAME_HEIGHT)
    letters = torch.full((3,), _NAME_HEIGHT)
    name = f"{each.name}, {state}"
    return [
        _marker(stamp, "boxes", each.id, Marker.CUBE, state, T_mb=T_mb, size=size, opacity=_BOX_OPACITY),
        _marker(stamp, "names", each.id, Marker.TEXT_VIEW_FACING, state, T_mb=above, size=letters, text=name),
    ]


def _arrow(stamp: float, each: TrackedObject, T_mw: Tensor) -> Marker:
    start = points_in_map(each.centroid, T_mw)
    end = points_in_map(each.state.predict(each.state.stamp + 1.0).position, T_mw)
    return _marker(
        stamp,
        "velocities",
        each.id,
        Marker.ARROW,
        each.motion_state.value,
        size=torch.tensor(_ARROW),
        points=[start, end],
    )


def _marker(
    stamp: float,
    namespace: str,
    number: int,
    kind: int,
    motion_state: str,
    *,
    T_mb: Tensor = _IDENTITY,
    size: Tensor = _UNIT,
    opacity: float = 1.0,
    text: str = "",
    points: Sequence[Tensor] = (),
    action: int = Marker.ADD,
) -> Marker:
    red, green, blue = to_rgb(MOTION_STATE_COLOURS[motion_state])
    return Marker(
        header(stamp, MAP),
        namespace,
        number,
        kind,
        action,
        pose(T_mb),
        vector(size),
        ros.std_msgs__msg__ColorRGBA(red, green, blue, opacity),
        ros.builtin_interfaces__msg__Duration(0, 0),  # until the next frame removes it
        frame_locked=False,
        points=[point(each) for each in points],
        colors=[],
        texture_resource="",
        texture=ros.sensor_msgs__msg__CompressedImage(header(stamp, MAP), "", np.zeros(0, np.uint8)),
        uv_coordinates=[],
        text=text,
        mesh_resource="",
        mesh_file=ros.visualization_msgs__msg__MeshFile("", np.zeros(0, np.uint8)),
        mesh_use_embedded_materials=False,
    )
