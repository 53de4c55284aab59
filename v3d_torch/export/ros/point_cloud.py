"""ROS 2 message of a coloured point cloud."""

from __future__ import annotations

import numpy as np
from rosbags.typesys.stores import ros2_humble as ros
from torch import Tensor

from v3d_torch.export.ros.messages import header

_FIELDS = ("x", "y", "z", "rgb")
"""Fields of a point, 32-bit floats. As in PCL, the four bytes of ``rgb`` are blue, green, red and 0."""

_SIZE = 4
"""Bytes of a field."""


def point_cloud(stamp: float, frame: str, points: Tensor, colours: Tensor) -> ros.sensor_msgs__msg__PointCloud2:
    """Make a coloured point cloud.

    Args:
        stamp: Timestamp, seconds.
        frame: Name of the coordinate frame of the points.
        points: Points without NaN, metres, shape :math:`(N, 3)`.
        colours: RGB of the points, uint8, shape :math:`(N, 3)`.
    """
    rows = np.empty((len(points), len(_FIELDS)), dtype="<f4")
    rows[:, :3] = points.numpy()
    red, green, blue = colours.numpy().T.astype("<u4")
    rows[:, 3] = ((red << 16) | (green << 8) | blue).view("<f4")
    kind = ros.sensor_msgs__msg__PointField.FLOAT32
    return ros.sensor_msgs__msg__PointCloud2(
        header(stamp, frame),
        1,
        len(rows),
        [ros.sensor_msgs__msg__PointField(name, _SIZE * place, kind, 1) for place, name in enumerate(_FIELDS)],
        is_bigendian=False,
        point_step=_SIZE * len(_FIELDS),
        row_step=rows.nbytes,
        data=rows.reshape(-1).view(np.uint8),
        is_dense=True,
    )
