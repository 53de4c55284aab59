"""The pixels around an object's points in the image, and those whose depth its points explain.

A network draws outlines at a quarter of the image's resolution: it rounds off hands and takes slices of the wall along.
The object's cloud, cleaned of what does not belong to it, says which depths are its own, place by place.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

from v3d_torch.camera import PinholeCamera

_CELL = 4
"""Side of the cells in which the depths of a cloud are gathered, pixels: those of the network's masks."""

_NONE = 1e6
"""Depth of cells without points, metres: farther than anything."""


_NEAREST = 0.1
"""Points nearer than this, or behind the camera, have no place in the image, metres."""


def silhouette(
    cloud: Tensor, depth: Tensor, camera: PinholeCamera, spacing: float, margin: int, tolerance: float
) -> tuple[Tensor, Tensor]:
    """Pixels near an object's points in the image, and those of them that its depths explain.

    Args:
        cloud: camera frame, metres, shape :math:`(P, 3)`.
        depth: metres, shape :math:`(1, H, W)`; 0 = no measurement.
        camera: of both.
        spacing: of the points, metres: gaps of this size are closed.
        margin: pixels by which the outline is farther out than the outermost points.
        tolerance: metres by which depth may lie before or behind the points around it.

    Returns:
        near and explained, bool, both of shape :math:`(H, W)`; none where the cloud has no points before the camera.
    """
    height, width = depth.shape[-2:]
    pixels, inside = camera.locate(cloud.to(torch.float64), _NEAREST)
    if not inside.any():
        nowhere = torch.zeros(height, width, dtype=torch.bool)
        return nowhere, nowhere
    rows, columns = -(-height // _CELL), -(-width // _CELL)
    # Pixel centres lie at integers: a cell begins half a pixel before its first.
    u, v = ((pixels[inside] + 0.5) / _CELL).floor().to(torch.int64).unbind(dim=1)
    cell, z = v * columns + u, cloud[inside, 2].to(torch.float32)
    front = torch.full((rows * columns,), _NONE).scatter_reduce_(0, cell, z, "amin").reshape(rows, columns)
    back = torch.full((rows * columns,), -_NONE).scatter_reduce_(0, cell, z, "amax").reshape(rows, columns)
    reach = (margin + spacing * camera.fx / float(z.median())) / _CELL
    side = 2 * max(round(reach), 1) + 1
    around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    nearest = _enlarged(cv2.erode(front.numpy(), around, borderValue=_NONE), height, width)
    farthest = _enlarged(cv2.dilate(back.numpy(), around, borderValue=-_NONE), height, width)
    return nearest < _NONE, (depth[0] > nearest - tolerance) & (depth[0] < farthest + tolerance)


def _enlarged(cells: np.ndarray, height: int, width: int) -> Tensor:
    return torch.from_numpy(cells).repeat_interleave(_CELL, 0).repeat_interleave(_CELL, 1)[:height, :width]
