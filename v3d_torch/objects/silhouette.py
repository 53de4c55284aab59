"""The pixels around an object's points in the image, and those whose depth its points explain.

A network draws outlines at a quarter of the image's resolution: it rounds off hands and takes slices of the wall along.
The object's cloud, cleaned of what does not belong to it, says which depths are its own, place by place.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.camera import PinholeCamera

_CELL = 4
"""Side of the cells in which the depths of a cloud are gathered, pixels: those of the network's masks."""

_NONE = 1e6
"""Depth of cells without points, metres: farther than anything."""

_NEAREST = 0.1
"""Points nearer than this, or behind the camera, have no place in the image, metres."""


class Silhouette:
    """A cloud as it lies in an image.

    Args:
        cloud: camera frame, metres, shape :math:`(P, 3)`.
        camera: that takes the image.
        spacing: of the points, metres: gaps of this size are closed.
    """

    def __init__(self, cloud: Tensor, camera: PinholeCamera, spacing: float) -> None:
        self._size = camera.height, camera.width
        pixels, inside = camera.locate(cloud.to(torch.float64), _NEAREST)
        seen = inside.numpy()
        self._z = cloud[:, 2].to(torch.float32).numpy()[seen]
        # Pixel centres lie at integers: a cell begins half a pixel before its first.
        self._cells = np.floor((pixels.numpy()[seen] + 0.5) / _CELL).astype(np.int64)
        self._gap = spacing * camera.fx / float(np.median(self._z)) if len(self._z) else 0.0

    def __call__(self, depth: Tensor, margin: int, tolerance: float) -> tuple[Tensor, Tensor]:
        """Pixels near the points, and those of them that the points' depths explain.

        Args:
            depth: metres, shape :math:`(1, H, W)`; 0 = no measurement.
            margin: pixels by which the outline is farther out than the outermost points.
            tolerance: metres by which depth may lie before or behind the points around it.

        Returns:
            near and explained, bool, both of shape :math:`(H, W)`; none where no point is in the image.
        """
        height, width = self._size
        near = torch.zeros(height, width, dtype=torch.bool)
        explained = torch.zeros_like(near)
        if len(self._z) == 0:
            return near, explained
        radius = max(round((margin + self._gap) / _CELL), 1)
        # Nothing is near beyond the radius: all that follows looks at this part of the image only.
        left, top = np.maximum(self._cells.min(axis=0) - radius, 0).tolist()
        right, bottom = (self._cells.max(axis=0) + radius + 1).tolist()
        here = slice(top * _CELL, min(bottom * _CELL, height)), slice(left * _CELL, min(right * _CELL, width))
        rows, columns = -(-here[0].stop // _CELL) - top, -(-here[1].stop // _CELL) - left
        cell = (self._cells[:, 1] - top) * columns + self._cells[:, 0] - left
        front, back = np.full(rows * columns, _NONE, np.float32), np.full(rows * columns, -_NONE, np.float32)
        np.minimum.at(front, cell, self._z)
        np.maximum.at(back, cell, self._z)
        around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
        nearest = cv2.erode(front.reshape(rows, columns), around, borderValue=_NONE)
        farthest = cv2.dilate(back.reshape(rows, columns), around, borderValue=-_NONE)
        near[here] = _enlarged(nearest < _NONE, near[here].shape)
        low, high = (_enlarged(z, near[here].shape) for z in (nearest - tolerance, farthest + tolerance))
        explained[here] = (depth[0][here] > low) & (depth[0][here] < high)
        return near, explained


def _enlarged(cells: NDArray[np.generic], size: torch.Size) -> Tensor:
    """Each cell as its pixels, the last ones cut to the size."""
    return torch.from_numpy(cells.repeat(_CELL, axis=0).repeat(_CELL, axis=1)[: size[0], : size[1]])
