"""The pixels that an object takes from tracking: its mask, the rim that was cut off, the surface that goes on.

A network draws coarse outlines, and of somebody half in the image it often finds the head and leaves the sleeve. The
depth tells more: the rim of a mask belongs to the object where its depth is the object's own, and a surface that goes
on from there without an edge is still the object, unless the camera saw it there before the object came.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from v3d_torch.config import StaticMaskConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.objects.free_space_check import DepthView, NewlyOccupied
from v3d_torch.objects.mask_ops import dilate, upsample_nearest
from v3d_torch.objects.silhouette import silhouettes
from v3d_torch.objects.track import Track


class MaskRefiner:
    """Draws the outlines of objects of one frame.

    Args:
        tracks: the objects.
        view: depth of the frame, and its pose.
        arrivals: what came since earlier frames, on every n-th pixel.
        config: margins and tolerances.
        camera: of the frame.
        spacing: of the objects' points, metres.
    """

    def __init__(
        self,
        tracks: Sequence[Track],
        view: DepthView,
        arrivals: NewlyOccupied,
        config: StaticMaskConfig,
        camera: PinholeCamera,
        spacing: float,
    ) -> None:
        self._view = view
        self._config = config
        self._stride = arrivals.stride
        self._open = _smooth(view, self._stride, config.edge_ratio) & ~arrivals.still
        located = [track for track in tracks if track.newest.is_located]
        R, t = view.T_cw[:3, :3], view.T_cw[:3, 3]
        clouds = [track.cloud_at(view.stamp) @ R.T + t for track in located]
        distances = [float(cloud[:, 2].median()) for cloud in clouds]
        self._seen = dict(zip(located, zip(silhouettes(clouds, camera, spacing), distances, strict=True), strict=True))

    def __call__(self, track: Track) -> Tensor:
        """Pixels of one of the objects, bool, shape :math:`(H, W)`."""
        config, depth = self._config, self._view.depth
        if track not in self._seen:  # too few points to tell which depths are its own
            return track.mask if track.missed else dilate(track.mask, config.depth_margin)
        silhouette, distance = self._seen[track]
        tolerance = config.depth_tolerance + config.tolerance_growth * distance**2
        outline = self._going_on(track, silhouette(depth, config.surface_margin, tolerance))
        if track.missed:  # a mask that is predicted by its depth is as it is
            return outline.logical_or_(track.mask)
        explained = silhouette(depth, config.depth_margin, tolerance).logical_or_(self._view.missing)
        rim = dilate(track.mask, config.depth_margin).logical_and_(explained)
        return outline.logical_or_(rim).logical_or_(track.cloud_pixels)

    def _going_on(self, track: Track, reached: Tensor) -> Tensor:
        """Where an object's pixels go on within reach, up to the next edge, bool, shape (H, W)."""
        if self._config.surface_margin == 0:
            return track.cloud_pixels & reached
        step = self._stride
        seed = track.cloud_pixels[::step, ::step]
        near = dilate(track.mask[::step, ::step], self._config.surface_margin // step)
        region = (seed | (near & reached[::step, ::step] & self._open)).view(torch.uint8).numpy()
        # With a cell to spare, to grow into.
        left, top, width, height = cv2.boundingRect(region)
        rows, columns = slice(max(top - 1, 0), top + height + 1), slice(max(left - 1, 0), left + width + 1)
        count, parts = cv2.connectedComponents(region[rows, columns], connectivity=4)
        size = np.bincount(parts.ravel(), minlength=count)
        seeds = np.bincount(parts[seed.numpy()[rows, columns]], minlength=count)
        # A surface of which the object is but a small part is what it stands on or leans against.
        taken = seeds >= self._config.min_surface_fraction * size
        taken[0] = False
        outline = torch.zeros_like(reached)
        part = tuple(slice(step * cells.start, step * cells.stop) for cells in (rows, columns))
        within = reached[part]
        # Up to the edge: the pixels between the last one looked at and it.
        outline[part] = upsample_nearest(dilate(torch.from_numpy(taken[parts]), 1).numpy(), step, within.shape) & within
        return outline


def _smooth(view: DepthView, step: int, edge: float) -> Tensor:
    """Every n-th pixel around which, halfway to the next ones, depth differs by less than this share of it."""
    depth, side = view.depth[0].numpy(), step + 1
    nearest = view.min_depth_around(side)[::step, ::step]
    farthest = cv2.dilate(depth, np.ones((side, side), np.uint8))[::step, ::step]
    at = depth[::step, ::step]
    return torch.from_numpy((at > 0) & (farthest - nearest < edge * at))
