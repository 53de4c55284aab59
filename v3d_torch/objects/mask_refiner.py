"""Mask refinement: pixels of an object beyond the mask of the network.

The contours of a network are coarse, and its mask of a person who is partly in the image often misses an arm. Depth
corrects both. Pixels around a mask belong to the object if their depth agrees with the object's points. A surface that
continues from there without a depth edge or a concave edge also belongs to the object, unless the surface was there
before the object.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.config import StaticMaskConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.kernels import masks as kernels
from v3d_torch.kernels.compiler import compiled_by
from v3d_torch.objects.depth_view import DepthView
from v3d_torch.objects.mask_ops import dilate, ellipse, subsample, upsample_nearest
from v3d_torch.objects.newly_occupied import NewlyOccupied
from v3d_torch.objects.silhouette import silhouettes
from v3d_torch.objects.surface_edges import find_concave_edges, find_smooth_pixels
from v3d_torch.objects.track import Track, predict_clouds

_TOLERANCE_GROWTH = 0.01
"""Growth of the depth tolerance with the square of depth, 1/m: seven times the standard deviation of the
depth of a structured-light camera."""

_MIN_PART_RADIUS = 8
"""Minimum radius of a part of a mask that is kept because its surface was not there before, pixels."""


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
        self._newly_occupied = newly_occupied
        self._stride = newly_occupied.stride
        with_centroid = [track for track in tracks if track.newest.has_centroid]
        clouds = predict_clouds(with_centroid, view.stamp, view.T_cw)
        median_depths = [float(cloud[:, 2].median()) for cloud in clouds]
        projected = silhouettes(clouds, camera, spacing)
        self._silhouettes = dict(zip(with_centroid, zip(projected, median_depths, strict=True), strict=True))

    @cached_property
    def _concave(self) -> NDArray[np.bool_]:
        """Concave edges, at every n-th pixel."""
        return find_concave_edges(self._view.depth[0].numpy()[:: self._stride, :: self._stride])

    @cached_property
    def _previously_occupied(self) -> NDArray[np.bool_]:
        """Every n-th pixel whose surface was there before."""
        return self._newly_occupied.previously_occupied.numpy()

    @cached_property
    def _new_surface(self) -> NDArray[np.bool_]:
        """Every n-th pixel with depth whose surface was not there before."""
        return ~(self._previously_occupied | self._view.missing.numpy()[:: self._stride, :: self._stride])

    @cached_property
    def _growable(self) -> NDArray[np.bool_]:
        """Every n-th pixel over which a surface can grow: no edge, and not occupied before the object appeared."""
        smooth = find_smooth_pixels(self._view.depth[0].numpy(), self._stride, self._config.edge_ratio)
        return smooth & ~(self._concave | self._previously_occupied)

    def refine(self, track: Track) -> Tensor:
        """Return the refined mask of one of the objects, bool, shape :math:`(H, W)`."""
        config, depth = self._config, self._view.depth
        if track not in self._silhouettes:  # too few points for a depth range of the object
            # A predicted mask already agrees with the depth; without points it is the last one.
            is_predicted = track.missed and len(track.newest.cloud) > 0
            return track.mask if is_predicted else dilate(track.mask, config.depth_margin)
        silhouette, median_depth = self._silhouettes[track]
        tolerance = config.depth_tolerance + _TOLERANCE_GROWTH * median_depth**2
        # NumPy combines masks faster here than torch.
        mask = self._grow_surface(track, silhouette.mask(depth, config.surface_margin, tolerance)).numpy()
        if track.missed:  # a predicted mask already agrees with the depth
            mask |= track.mask.numpy()
            return torch.from_numpy(mask)
        agreeing = silhouette.mask(depth, config.depth_margin, tolerance).numpy()
        agreeing |= self._view.missing.numpy()
        agreeing &= dilate(track.mask, config.depth_margin).numpy()
        mask |= agreeing
        mask |= track.cloud_pixels.numpy()
        self._add_new_parts(track, mask)
        return torch.from_numpy(mask)

    def _add_new_parts(self, track: Track, mask: NDArray[np.bool_]) -> None:
        """Add the parts of the network's mask whose surface was not there before to the refined mask, in place.

        A network sometimes draws one mask over two people; the second one is not known background.
        """
        stride = self._stride
        cells = track.mask.numpy()[::stride, ::stride] & ~mask[::stride, ::stride] & self._new_surface
        # Contours are coarse: narrow parts along them are background that was not observed before.
        kernel = ellipse(max(_MIN_PART_RADIUS // stride, 1))
        parts = cv2.morphologyEx(cells.view(np.uint8), cv2.MORPH_OPEN, kernel).view(np.bool_)
        if parts.any():
            pixels = upsample_nearest(parts, stride, mask.shape).numpy()
            mask |= pixels & track.mask.numpy() & ~self._view.missing.numpy()

    def _grow_surface(self, track: Track, reachable: Tensor) -> Tensor:
        """Grow an object's pixels within the reachable ones up to the next edge, bool, shape (H, W)."""
        if self._config.surface_margin == 0:
            return track.cloud_pixels & reachable
        stride = self._stride
        seeds = track.cloud_pixels.numpy()[::stride, ::stride]
        near = dilate(subsample(track.mask, stride), self._config.surface_margin // stride).numpy()
        near &= reachable.numpy()[::stride, ::stride]
        near &= self._growable
        near |= seeds & ~self._concave
        return _fill_surfaces(
            torch.from_numpy(near), track.cloud_pixels, reachable, stride, self._config.min_surface_fraction
        )


def _components(region: NDArray[np.uint8]) -> tuple[int, NDArray[np.int32], tuple[slice, slice]]:
    """Return the number of connected components, and the component of each cell in the returned rows and columns."""
    # Crop to the region, with a margin of one cell for the final dilation.
    left, top, width, height = cv2.boundingRect(region)
    crop = slice(max(top - 1, 0), top + height + 1), slice(max(left - 1, 0), left + width + 1)
    count, components = cv2.connectedComponents(region[crop], connectivity=4)
    return count, np.asarray(components, np.int32), crop


def _fill_surfaces_compiled(
    region: Tensor, pixels: Tensor, reachable: Tensor, stride: int, min_fraction: float
) -> Tensor:
    count, components, (rows, columns) = _components(region.view(torch.uint8).numpy())
    seeds = np.ascontiguousarray(pixels.view(torch.uint8).numpy()[::stride, ::stride][rows, columns])
    crop = slice(stride * rows.start, stride * rows.stop), slice(stride * columns.start, stride * columns.stop)
    surface = np.zeros(reachable.shape, np.uint8)
    in_crop = np.ascontiguousarray(reachable.view(torch.uint8).numpy()[crop])
    surface[crop] = kernels.fill_components(components, count, seeds, in_crop, stride, min_fraction)
    return torch.from_numpy(surface).view(torch.bool)


@compiled_by(_fill_surfaces_compiled)
def _fill_surfaces(region: Tensor, pixels: Tensor, reachable: Tensor, stride: int, min_fraction: float) -> Tensor:
    """Select the surfaces of a region that belong to an object.

    Args:
        region: Cells of the object and of smooth surfaces near it, bool, shape :math:`(h, w)`.
        pixels: Pixels of the object, bool, shape :math:`(H, W)`.
        reachable: Pixels that can be selected, bool, shape :math:`(H, W)`.
        stride: Side of a cell, pixels.
        min_fraction: Minimum fraction of a surface that lies on the object.

    Returns:
        Reachable pixels of the connected surfaces that lie on the object to a sufficient fraction, bool, shape
        :math:`(H, W)`.
    """
    count, components, (rows, columns) = _components(region.view(torch.uint8).numpy())
    size = np.bincount(components.ravel(), minlength=count)
    seeds = np.bincount(components[pixels.numpy()[::stride, ::stride][rows, columns]], minlength=count)
    # If the object is only a small part of a surface, it stands on the surface or leans against it.
    selected = seeds >= min_fraction * size
    selected[0] = False
    surface = torch.zeros_like(reachable)
    crop = slice(stride * rows.start, stride * rows.stop), slice(stride * columns.start, stride * columns.stop)
    in_crop = reachable[crop]
    # Dilate by one cell to include the pixels between the last checked pixel and the edge.
    cells = dilate(torch.from_numpy(selected[components]), 1).numpy()
    surface[crop] = upsample_nearest(cells, stride, in_crop.shape) & in_crop
    return surface
