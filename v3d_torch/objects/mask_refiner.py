"""Mask refinement: pixels of an object beyond the mask of the network.

A network draws coarse contours, and of a person who is partly in the image it often segments the head and misses an
arm. Depth corrects both. The rim of a mask belongs to the object if its depth agrees with the object's points. A
surface that continues from there without a depth edge also belongs to the object, unless it was there before.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from v3d_torch.config import StaticMaskConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.objects.free_space_check import DepthView
from v3d_torch.objects.mask_ops import dilate, upsample_nearest
from v3d_torch.objects.newly_occupied import NewlyOccupied
from v3d_torch.objects.silhouette import silhouettes
from v3d_torch.objects.track import Track

_TOLERANCE_GROWTH = 0.01
"""Growth of the depth tolerance with the square of depth, 1/m: four times the error of a structured-light camera."""


class MaskRefiner:
    """Refinement of the masks of the objects of one frame.

    Args:
        tracks: Tracks of the objects.
        view: Depth and pose of the frame.
        newly_occupied: Newly occupied pixels of the frame.
        config: Margins and tolerances.
        camera: Camera of the frame.
        spacing: Spacing of the objects' points, metres.
    """

    def __init__(
        self,
        tracks: Sequence[Track],
        view: DepthView,
        newly_occupied: NewlyOccupied,
        config: StaticMaskConfig,
        camera: PinholeCamera,
        spacing: float,
    ) -> None:
        self._view = view
        self._config = config
        self._stride = newly_occupied.stride
        # Pixels that a surface can grow over: no depth edge, and not occupied before the object appeared.
        smooth = _smooth_pixels(view, self._stride, config.edge_ratio)
        self._growable = smooth & ~newly_occupied.previously_occupied
        located = [track for track in tracks if track.newest.is_located]
        R, t = view.T_cw[:3, :3], view.T_cw[:3, 3]
        clouds = [track.predict_cloud(view.stamp) @ R.T + t for track in located]
        median_depths = [float(cloud[:, 2].median()) for cloud in clouds]
        projected = silhouettes(clouds, camera, spacing)
        self._silhouettes = dict(zip(located, zip(projected, median_depths, strict=True), strict=True))

    def refine(self, track: Track) -> Tensor:
        """Return the refined mask of one of the objects, bool, shape :math:`(H, W)`."""
        config, depth = self._config, self._view.depth
        if track not in self._silhouettes:  # too few points for a depth range of the object
            return track.mask if track.missed else dilate(track.mask, config.depth_margin)
        silhouette, median_depth = self._silhouettes[track]
        tolerance = config.depth_tolerance + _TOLERANCE_GROWTH * median_depth**2
        surface = self._grow_surface(track, silhouette.mask(depth, config.surface_margin, tolerance))
        if track.missed:  # a predicted mask already agrees with the depth
            return surface.logical_or_(track.mask)
        agreeing = silhouette.mask(depth, config.depth_margin, tolerance).logical_or_(self._view.missing)
        rim = dilate(track.mask, config.depth_margin).logical_and_(agreeing)
        return surface.logical_or_(rim).logical_or_(track.cloud_pixels)

    def _grow_surface(self, track: Track, reachable: Tensor) -> Tensor:
        """Grow an object's pixels within the reachable ones up to the next depth edge, bool, shape (H, W)."""
        if self._config.surface_margin == 0:
            return track.cloud_pixels & reachable
        step = self._stride
        seed = track.cloud_pixels[::step, ::step]
        near = dilate(track.mask[::step, ::step], self._config.surface_margin // step)
        region = (seed | (near & reachable[::step, ::step] & self._growable)).view(torch.uint8).numpy()
        # Crop to the region, with a margin of one cell for the final dilation.
        left, top, width, height = cv2.boundingRect(region)
        rows, columns = slice(max(top - 1, 0), top + height + 1), slice(max(left - 1, 0), left + width + 1)
        count, components = cv2.connectedComponents(region[rows, columns], connectivity=4)
        size = np.bincount(components.ravel(), minlength=count)
        seeds = np.bincount(components[seed.numpy()[rows, columns]], minlength=count)
        # If the object is only a small part of a surface, it stands on the surface or leans against it.
        selected = seeds >= self._config.min_surface_fraction * size
        selected[0] = False
        surface = torch.zeros_like(reachable)
        crop = tuple(slice(step * cells.start, step * cells.stop) for cells in (rows, columns))
        in_crop = reachable[crop]
        # Dilate by one cell to include the pixels between the last checked pixel and the edge.
        cells = dilate(torch.from_numpy(selected[components]), 1).numpy()
        surface[crop] = upsample_nearest(cells, step, in_crop.shape) & in_crop
        return surface


def _smooth_pixels(view: DepthView, step: int, edge_ratio: float) -> Tensor:
    """Return every n-th pixel around which depth varies by less than a fraction of it, within half the step."""
    depth, size = view.depth[0].numpy(), step + 1
    nearest = view.min_depth_around(size)[::step, ::step]
    farthest = cv2.dilate(depth, np.ones((size, size), np.uint8))[::step, ::step]
    centre = depth[::step, ::step]
    return torch.from_numpy((centre > 0) & (farthest - nearest < edge_ratio * centre))
