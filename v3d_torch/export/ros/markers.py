"""ROS 2 markers of the objects of a frame: box, name and velocity, in the colour of the motion state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from matplotlib.colors import to_rgb
from rosbags.typesys.stores import ros2_humble as ros
from torch import Tensor

from v3d_torch.export.ros.frames import MAP, points_in_map
from v3d_torch.export.ros.messages import header, point, vector
from v3d_torch.objects.frame_objects import FrameObjects, MotionState, TrackedObject
from v3d_torch.viz.object_overlay import MOTION_STATE_COLOURS

Marker = ros.visualization_msgs__msg__Marker

_BOX_OPACITY = 0.4

_NAME_HEIGHT = 0.15
"""Height of a letter, metres."""

_ARROW = (0.03, 0.06, 0.1)
"""Diameter of the shaft, diameter and length of the head of an arrow, metres."""

_MIN_SIZE = 0.02
"""Smallest side of a box, metres: viewers reject boxes without volume."""

_ORIGIN, _UNIT = torch.zeros(3), torch.ones(3)


def object_markers(
    stamp: float, objects: FrameObjects, velocities: Mapping[int, Tensor], T_mw: Tensor
) -> ros.visualization_msgs__msg__MarkerArray:
    """Make the markers of a frame, in ``map``. The first marker removes the markers of the previous frame.

    An arrow ends where the object will be one second later. Objects without a centroid or a cloud have no markers.

    Args:
        stamp: Timestamp, seconds.
        objects: Objects of the frame.
        velocities: Velocity of objects, world frame, m/s, float64, shape :math:`(3,)`, by id. Dynamic objects get an
            arrow.
        T_mw: Transform from the world frame to ``map``, float64, shape :math:`(4, 4)`.
    """
    markers = [_marker(stamp, "", 0, Marker.CUBE, "unknown", action=Marker.DELETEALL)]
    for each in objects.objects:
        if len(each.cloud) and bool(each.centroid.isfinite().all()):
            markers += _box_and_name(stamp, each, T_mw)
            if each.motion_state is MotionState.DYNAMIC and each.id in velocities:
                markers.append(_arrow(stamp, each, velocities[each.id], T_mw))
    return ros.visualization_msgs__msg__MarkerArray(markers)  # type: ignore[arg-type]  # rosbags annotates an old Marker


def _box_and_name(stamp: float, each: TrackedObject, T_mw: Tensor) -> list[Marker]:
    low, high = _bounds(each, T_mw)
    state = each.motion_state.value
    centre, size = (low + high) / 2, (high - low).clamp(min=_MIN_SIZE)
    above, letters = torch.cat([centre[:2], high[2:] + _NAME_HEIGHT]), torch.full((3,), _NAME_HEIGHT)
    name = f"{each.name}, {state}"
    return [
        _marker(stamp, "boxes", each.id, Marker.CUBE, state, centre=centre, size=size, opacity=_BOX_OPACITY),
        _marker(stamp, "names", each.id, Marker.TEXT_VIEW_FACING, state, centre=above, size=letters, text=name),
    ]


def _arrow(stamp: float, each: TrackedObject, velocity: Tensor, T_mw: Tensor) -> Marker:
    start = points_in_map(each.centroid, T_mw)
    end = start + points_in_map(velocity, T_mw)
    return _marker(
        *(stamp, "velocities", each.id, Marker.ARROW, each.motion_state.value),
        size=torch.tensor(_ARROW),
        points=[start, end],
    )


def _bounds(each: TrackedObject, T_mw: Tensor) -> tuple[Tensor, Tensor]:
    """Smallest and largest coordinates of an object in ``map``, shape (3,) each.

    The cloud of a missed object is that of its last detection, moved to the predicted centroid.
    """
    cloud = points_in_map(each.cloud, T_mw)
    motion = points_in_map(each.centroid, T_mw) - cloud.mean(dim=0) if each.missed else 0.0
    return cloud.amin(dim=0) + motion, cloud.amax(dim=0) + motion


def _marker(
    stamp: float,
    namespace: str,
    number: int,
    kind: int,
    motion_state: str,
    *,
    centre: Tensor = _ORIGIN,
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
        ros.geometry_msgs__msg__Pose(point(centre), ros.geometry_msgs__msg__Quaternion(0.0, 0.0, 0.0, 1.0)),
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
