"""Partial views of objects: the part of an object that is visible, and where the whole object must be.

The centroid of a person who is half hidden, or cut off by the image border, is not the centroid of the person. Each track
keeps a reference cloud, taken when most of the object was visible. The depth image tells which of its points are visible
at the predicted position. Comparing the visible points with the points that an instance has in common with them gives
the position of the whole object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera

_MIN_DEPTH = 0.1
"""Points nearer than this, or behind the camera, are not in view, metres."""

_DEPTH_TOLERANCE = 0.2
"""Tolerance of the depth of a predicted point, metres: arms and legs swing by this much."""

_MARGIN = 0.06
"""Distance from the predicted points up to which an instance has a region in common with them, metres."""

_MIN_PARTIAL = 0.1
"""Hidden or new fraction from which a view is partial: contours vary by some hundredths of an object."""

_CUT_OFF_FRACTION = 0.5
"""Assumed hidden fraction of a new object that the image border cuts off."""

_MIN_POINTS = 20
"""Minimum number of points of a part; the mean of fewer points is noise."""


@dataclass(frozen=True)
class ReferenceView:
    """Reference cloud of an object at its predicted position, compared with the depth image.

    Attributes:
        position: Predicted position, world frame, metres, float64, shape :math:`(3,)`.
        visible_centroid: Centroid of the visible points, world frame, metres, float64, shape :math:`(3,)`.
        visible_count: Number of visible points.
        hidden_fraction: Fraction of the points that are occluded or outside of the image.
        region: Coarse pixels near the points, bool, shape :math:`(h, w)`.
    """

    position: Tensor
    visible_centroid: Tensor
    visible_count: int
    hidden_fraction: float
    region: NDArray[np.bool_]


@dataclass(frozen=True)
class PositionMeasurement:
    """Measured position of an object that may be visible in part only.

    Attributes:
        position: Position of the whole object, world frame, metres, float64, shape :math:`(3,)`; NaN if unknown.
        hidden_fraction: Fraction of the reference cloud that is not visible.
        new_fraction: Fraction of the instance that is not part of the reference cloud.
    """

    position: Tensor
    hidden_fraction: float
    new_fraction: float

    @property
    def is_complete(self) -> bool:
        """True if the instance shows the object as completely as its reference cloud."""
        return max(self.hidden_fraction, self.new_fraction) <= _MIN_PARTIAL

    @property
    def shows_more(self) -> bool:
        """True if the instance shows more of the object than its reference cloud."""
        return self.new_fraction > max(self.hidden_fraction, _MIN_PARTIAL)


def view_references(
    positions: Sequence[Tensor], references: Sequence[Tensor], depth: Tensor, T_cw: Tensor, camera: PinholeCamera,
    stride: int,
) -> list[ReferenceView]:  # fmt: skip
    """Compare reference clouds with the depth image.

    Args:
        positions: Predicted positions of K objects, world frame, metres, float64, each of shape :math:`(3,)`.
        references: Reference clouds relative to the positions, float64, each of shape :math:`(P_k, 3)`, not empty.
        depth: Measured depth, metres, float32, shape :math:`(1, H, W)`; 0 = no measurement.
        T_cw: World-to-camera pose, float64, shape :math:`(4, 4)`.
        camera: Camera of the depth image.
        stride: Step between the coarse pixels, pixels.
    """
    if not references:
        return []
    points = torch.cat([reference + position for reference, position in zip(references, positions, strict=True)])
    z = points @ T_cw[2, :3] + T_cw[2, 3]
    cells, in_image = _coarse_pixels(points, T_cw, camera, stride)
    v, u = np.minimum(cells * stride + stride // 2, (camera.height - 1, camera.width - 1)).T
    measured = depth[0].numpy()[v, u]
    visible = in_image & ~((measured > 0) & (measured < z.numpy() - _DEPTH_TOLERANCE))
    shape = -(-camera.height // stride), -(-camera.width // stride)
    views, begin = [], 0
    for position, reference in zip(positions, references, strict=True):
        own = slice(begin, begin + len(reference))
        begin = own.stop
        count = int(visible[own].sum())
        distance = max(float(z[own].median()), _MIN_DEPTH)
        radius = max(round(_MARGIN * camera.fx / distance / stride), 1)
        views.append(
            ReferenceView(
                position=position,
                visible_centroid=torch.from_numpy(points[own].numpy()[visible[own]].sum(axis=0) / max(count, 1)),
                visible_count=count,
                hidden_fraction=1 - count / len(reference),
                region=_region(cells[own][in_image[own]], shape, radius),
            )
        )
    return views


def first_measurement(centroid: Tensor, mask: Tensor) -> PositionMeasurement:
    """Measure the position of a new object, of which an unknown part is hidden if the image border cuts it off.

    Args:
        centroid: Centroid of the instance, world frame, metres, float64, shape :math:`(3,)`; NaN if unknown.
        mask: Pixels of the instance, bool, shape :math:`(H, W)`.
    """
    pixels = mask.numpy()
    is_cut_off = any(bool(border.any()) for border in (pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]))
    return PositionMeasurement(centroid, _CUT_OFF_FRACTION if is_cut_off else 0.0, 0.0)


def measure_position(view: ReferenceView, centroid: Tensor, cloud: Tensor, cells: NDArray[np.int64]) -> PositionMeasurement:
    """Measure the position of the whole object from an instance.

    Args:
        view: Reference cloud of the object at its predicted position.
        centroid: Centroid of the instance, world frame, metres, float64, shape :math:`(3,)`; NaN if unknown.
        cloud: Points of the instance, world frame, metres, shape :math:`(P, 3)`.
        cells: Coarse pixel (row, column) of each point, shape :math:`(P, 2)`, see `coarse_cells`.
    """
    common = view.region[cells[:, 0], cells[:, 1]]
    new_fraction = 1 - float(common.mean()) if len(common) else 0.0
    measured = PositionMeasurement(centroid, view.hidden_fraction, new_fraction)
    if measured.is_complete or min(int(common.sum()), view.visible_count) < _MIN_POINTS:
        return measured
    common_centroid = torch.from_numpy(cloud.numpy()[common].mean(axis=0, dtype=np.float64))
    position = view.position + common_centroid - view.visible_centroid
    return PositionMeasurement(torch.where(centroid.isnan(), centroid, position), view.hidden_fraction, new_fraction)


def coarse_cells(cloud: Tensor, T_cw: Tensor, camera: PinholeCamera, stride: int) -> NDArray[np.int64]:
    """Project the points of an instance to coarse pixels (row, column), int64, shape (P, 2).

    Args:
        cloud: Points, world frame, metres, shape :math:`(P, 3)`.
        T_cw: World-to-camera pose, float64, shape :math:`(4, 4)`.
        camera: Camera of the image.
        stride: Step between the coarse pixels, pixels.
    """
    return _coarse_pixels(cloud.to(torch.float64), T_cw, camera, stride)[0]


def _coarse_pixels(
    points: Tensor, T_cw: Tensor, camera: PinholeCamera, stride: int
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the coarse pixel (row, column) of each point, 0 outside of the image, and the points in the image."""
    pixels, inside = camera.project_to_image(points @ T_cw[:3, :3].T + T_cw[:3, 3], _MIN_DEPTH)
    in_image = inside.numpy()
    coarse = np.floor((np.where(in_image[:, None], pixels.numpy(), 0.0) + 0.5) / stride).astype(np.int64)
    return coarse[:, ::-1], in_image


def _region(cells: NDArray[np.int64], shape: tuple[int, int], radius: int) -> NDArray[np.bool_]:
    """Return the coarse pixels within a distance of the cells, bool, (h, w)."""
    region = np.zeros(shape, np.uint8)
    region[cells[:, 0], cells[:, 1]] = 1
    return cv2.dilate(region, np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)).view(np.bool_)
