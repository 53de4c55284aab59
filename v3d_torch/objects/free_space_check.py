"""The background's word: places that were empty and are filled now, and places that are looked through now.

The paper's votes and Chamfer distances compare centroids and clouds, and both change when an object is cut by the image
border, covered by another one, or segmented differently. The camera's motion over the background, known from hundreds
of points, gives a test that does not: a point of a still object is seen again where it was, or is hidden. Where the
camera looks through the place, the point has gone; where an earlier view looked through it, the point has come.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import ClassVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.config import FreeSpaceConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert


@dataclass(frozen=True)
class DepthView:
    """What a depth image says of the world.

    Attributes:
        stamp: seconds.
        depth: metres, float32, shape :math:`(1, H, W)`; 0 = no measurement.
        T_cw: world to camera, float64, shape :math:`(4, 4)`.
        shift: pixels by which the depth may lie beside the colour that the pose is of, because the camera turned.
    """

    stamp: float
    depth: Tensor
    T_cw: Tensor
    shift: int = 0

    _SLACK: ClassVar[float] = 0.01  # of the image's width, 0.6 degrees of a Kinect's: poses are no better

    def __getstate__(self) -> dict[str, object]:
        """What it is made of, without what is cached."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def moved_to(self, T_cw: Tensor) -> DepthView:
        """The same image, taken from another pose: what is cached of it holds there as well."""
        view = replace(self, T_cw=T_cw)
        vars(view).update(vars(self) | {"T_cw": T_cw})
        return view

    @cached_property
    def missing(self) -> Tensor:
        """Pixels without depth, bool, shape :math:`(H, W)`."""
        return torch.from_numpy(self.depth[0].numpy() <= 0)  # in a third of torch's time

    @cached_property
    def nearest(self) -> Tensor:
        """The least depth around each pixel, metres, float32, shape :math:`(H, W)`; 0 where the pixel has none.

        A place counts as looked through only where all around it is: a surface seen at a grazing angle, or with a pose
        that is off by some pixels, would else seem to come and go.
        """
        depth = self.depth[0].numpy()
        side = 2 * (round(self._SLACK * depth.shape[1]) + self.shift) + 1
        return torch.from_numpy(self.min_depth_around(side) * (depth > 0))

    def min_depth_around(self, side: int) -> NDArray[np.float32]:
        """The least depth in a square around each pixel, metres, shape :math:`(H, W)`; above all where there is none.

        Args:
            side: of the square, pixels, odd.
        """
        depth = self.depth[0].numpy()
        none = cv2.threshold(depth, 0, float(np.finfo(np.float32).max), cv2.THRESH_BINARY_INV)[1]
        return np.asarray(cv2.erode(depth + none, np.ones((side, side), np.uint8)), np.float32)


def is_free_space(points: Tensor, view: DepthView, camera: PinholeCamera, config: FreeSpaceConfig) -> Tensor:
    """Whether a view looks through places.

    Args:
        points: world frame, metres, float64, shape :math:`(P, 3)`.
        view: of another time.
        camera: of the view.
        config: tolerances.

    Returns:
        1 where the view sees something behind the place, 0 where it sees something in it, nan where the place is
        hidden, outside the image or without depth; float64, shape :math:`(P,)`.
    """
    # Each coordinate in a row of its own: what follows takes half the time.
    seen = (view.T_cw[:3, :3] @ points.T + view.T_cw[:3, 3:]).T
    expected = seen[:, 2]
    pixels, inside = camera.locate(seen, config.min_depth)
    u, v = pixels.round().to(torch.int64).unbind(dim=1)
    place = torch.where(inside, v * camera.width + u, 0)
    measured = torch.where(inside, view.nearest.flatten().index_select(0, place), 0.0).to(torch.float64)
    tolerance = (config.tolerance * expected.square()).clamp(min=config.min_tolerance)
    in_sight = (measured > 0) & (measured > expected - tolerance)
    return torch.where(in_sight, (measured > expected + tolerance).to(torch.float64), torch.nan)


def vacated_fractions(
    clouds: Sequence[Tensor], view: DepthView, camera: PinholeCamera, config: FreeSpaceConfig
) -> Tensor:
    """Share of each cloud's points, of those in sight, whose place another view looks through.

    Args:
        clouds: of K objects, world frame, metres, each of shape :math:`(P_k, 3)`.
        view: of another time.
        camera: of the view.
        config: tolerances.

    Returns:
        Between 0 (all are there) and 1 (all are not); nan when too few are in sight to tell; float64, :math:`(K,)`.
    """
    if not clouds:
        return torch.zeros(0, dtype=torch.float64)
    told = is_free_space(torch.cat([cloud.to(torch.float64) for cloud in clouds]), view, camera, config)
    cloud = torch.arange(len(clouds)).repeat_interleave(torch.tensor([len(cloud) for cloud in clouds]))
    nothing = told.new_zeros(len(clouds))
    known = nothing.index_add(0, cloud, (~told.isnan()).to(told.dtype))
    return (nothing.index_add(0, cloud, told.nan_to_num()) / known).masked_fill(known < config.min_points, torch.nan)


@dataclass(frozen=True)
class NewlyOccupied:
    """Pixels whose point lies where an earlier view saw nothing.

    Attributes:
        came: 1 where it does, 0 where something was there before, nan where it cannot be told, float64, for each
            baseline, on every ``stride``-th pixel, shape :math:`(B, h, w)`.
        stride: pixels.
    """

    appeared: Tensor
    stride: int

    @property
    def still(self) -> Tensor:
        """Pixels of what was there before, over one baseline at least and none to the contrary, bool, (h, w)."""
        return (self.appeared == 0).any(dim=0) & ~(self.appeared == 1).any(dim=0)

    def fractions(self, masks: Sequence[Tensor], least: int) -> Tensor:
        """Share of each object's pixels that came.

        Args:
            masks: of K objects, bool, each of shape :math:`(H, W)`.
            least: fewer pixels of which it can be told make nan.

        Returns:
            For each object and baseline, float64, shape :math:`(K, B)`.
        """
        step, told = self.stride, self.appeared.flatten(1)
        if not masks:
            return told.new_zeros(0, len(told))
        within = np.stack([mask.numpy()[::step, ::step] for mask in masks]).reshape(len(masks), -1)
        # Float32 counts pixels exactly, and in half the time.
        counted = torch.cat([told == 1, ~told.isnan()]).to(torch.float32)
        counts = torch.from_numpy(within.astype(np.float32)) @ counted.T
        came, known = counts.to(told.dtype).chunk(2, dim=1)
        return (came / known).masked_fill(known < least, torch.nan)


class FreeSpaceCheck:
    """Remembers what was seen lately, and tells what has come since.

    Args:
        config: baselines and tolerances.
        camera: of all views.
    """

    _SLACK = 0.2  # seconds: a view as old as the baseline must be among the kept, at 5 frames a second too
    _ROW = 160  # pixels of a row that are looked at, of a Kinect's every 4th: 2 cm at 2.5 m, as fine as the clouds

    def __init__(self, config: FreeSpaceConfig, camera: PinholeCamera) -> None:
        self._config = config
        self._camera = camera
        self._views: list[DepthView] = []
        self._stride = max(1, round(camera.width / self._ROW))
        self._rays = camera.rays[:: self._stride, :: self._stride].reshape(-1, 3).T.to(torch.float64)

    def make_view(self, stamp: float, depth: Tensor, T_cw: Tensor) -> DepthView:
        """A view with what it may be off by, as fast as the camera has turned since the last one remembered.

        Args:
            stamp: seconds.
            depth: metres, shape :math:`(1, H, W)`.
            T_cw: world to camera, float64, shape :math:`(4, 4)`.
        """
        if not self._views:
            return DepthView(stamp, depth, T_cw)
        last = self._views[-1]
        angle = float(np.linalg.norm(cv2.Rodrigues((T_cw @ invert(last.T_cw))[:3, :3].numpy())[0]))
        rate = angle / max(stamp - last.stamp, 1e-3)
        return DepthView(stamp, depth, T_cw, round(self._camera.fx * rate * self._config.depth_sync_error))

    def __call__(self, now: DepthView, *, trusted: bool = True) -> NewlyOccupied:
        """Compare a view with those remembered.

        Args:
            now: the view.
            trusted: whether its pose is known. Against a guess all would seem to have come: then nothing is told.
        """
        config = self._config
        baselines = config.baselines if config.enabled and trusted else ()
        z = now.depth[0, :: self._stride, :: self._stride].to(torch.float64)
        came = torch.full((len(baselines), *z.shape), torch.nan, dtype=torch.float64)
        if not baselines:
            return NewlyOccupied(came, self._stride)
        known = torch.nonzero(((z > config.min_depth) & (z <= config.max_depth)).flatten())[:, 0]
        T_wc = invert(now.T_cw)
        seen = self._rays.index_select(1, known) * z.flatten().index_select(0, known)
        points = (T_wc[:3, :3] @ seen + T_wc[:3, 3:]).T
        for row, baseline in zip(came.flatten(1), baselines, strict=True):
            then = self._before(now.stamp - baseline)
            if then is not None:
                row[known] = is_free_space(points, then, self._camera, config)
        return NewlyOccupied(came, self._stride)

    def remember(self, view: DepthView) -> None:
        """Keep a view, its pose now as good as it gets, for those to come."""
        oldest = view.stamp - max(self._config.baselines, default=0.0) - self._SLACK
        self._views = [kept for kept in self._views if kept.stamp >= oldest] + [view]

    def move_world(self, T_new_old: Tensor) -> None:
        """Carry the views along when the map is corrected under them, float64, shape :math:`(4, 4)`."""
        self._views = [view.moved_to(view.T_cw @ invert(T_new_old)) for view in self._views]

    def _before(self, stamp: float) -> DepthView | None:
        """The newest view at least that old."""
        return next((view for view in reversed(self._views) if view.stamp <= stamp + 1e-3), None)
