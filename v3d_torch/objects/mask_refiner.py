"""Mask refinement: pixels of an object beyond the mask of the network.

The contours of a network are coarse, and its mask of a person who is partly in the image often misses an arm. Depth
corrects both. Pixels around a mask belong to the object if their depth agrees with the object's points. A surface that
continues from there without a depth edge or a concave edge also belongs to the object, unless the surface was there
before the object. Static surfaces of earlier views do not belong to it, however near they are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.config import ObjectsConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import transform_points
from v3d_torch.kernels import masks as kernels
from v3d_torch.kernels.compiler import compiled_by
from v3d_torch.objects.appeared_pixels import AppearedPixels
from v3d_torch.objects.crops import Crop, crop_around
from v3d_torch.objects.depth_view import DepthView
from v3d_torch.objects.dilation import dilate, ellipse
from v3d_torch.objects.resampling import upsample_nearest
from v3d_torch.objects.silhouette import CELL_SIZE, silhouettes
from v3d_torch.objects.static_surfaces import StaticSurfaces
from v3d_torch.objects.surface_edges import find_concave_edges, find_smooth_pixels
from v3d_torch.objects.track import Track, predict_clouds
from v3d_torch.segmentation.coco import PERSON

_INVERSE_DEPTH_TOLERANCE = 0.01
"""Tolerance of the inverse depth, 1/m: seven times the standard deviation of that of a structured-light camera."""

_MIN_PART_RADIUS, _MIN_COARSE_RADIUS = 8, 2
"""Minimum radius of a part of the network's mask that is kept beside the object's surface, pixels and coarse pixels: in
large images, the errors of the network's contour are larger."""


class RefinedMask(NamedTuple):
    """Refined mask in the part of the image that contains all of it.

    Attributes:
        crop: Rows and columns of the part; none if the mask is empty.
        surface: Pixels of the object there, bool, shape :math:`(h, w)`.
        mask: The pixels of ``surface``, and other parts of the network's mask: parts that are not known to have been
            there before, and parts that belonged to the object at its previous detection, bool, shape :math:`(h, w)`.
    """

    crop: Crop
    surface: NDArray[np.bool_]
    mask: NDArray[np.bool_]


class MaskRefiner:
    """Refinement of the masks of the objects of one frame.

    Args:
        tracks: Tracks of the objects.
        view: Depth and pose of the frame.
        appeared_pixels: Pixels of the frame that appeared.
        static_surfaces: Static surfaces of earlier views.
        config: Margins and tolerances of the masks, and the spacing of the clouds.
        camera: Camera of the frame.
    """

    def __init__(
        self,
        tracks: Sequence[Track],
        view: DepthView,
        appeared_pixels: AppearedPixels,
        static_surfaces: StaticSurfaces,
        config: ObjectsConfig,
        camera: PinholeCamera,
    ) -> None:
        self._people = [track for track in tracks if track.label == PERSON]
        self._view = view
        self._config = config.static_mask
        self._camera = camera
        self._spacing = config.clouds.voxel_size
        self._appeared_pixels = appeared_pixels
        self._static_surfaces = static_surfaces
        self._stride = appeared_pixels.stride
        self._step = math.lcm(self._stride, CELL_SIZE)
        # Maximum distance of a refined mask from the network's; surfaces are grown and filled in steps of the stride.
        self._reach = max(self._config.surface_margin, self._config.depth_margin) + 2 * self._stride
        with_centroid = [track for track in tracks if track.newest.has_centroid]
        clouds = predict_clouds(with_centroid, view.stamp, view.T_dw)
        median_depths = [float(cloud[:, 2].median()) for cloud in clouds]
        projected = silhouettes(clouds, camera, self._spacing)
        self._silhouettes = dict(zip(with_centroid, zip(projected, median_depths, strict=True), strict=True))

    @cached_property
    def _concave(self) -> NDArray[np.bool_]:
        """Concave edges, at every n-th pixel."""
        return find_concave_edges(self._view.depth[0].numpy()[:: self._stride, :: self._stride])

    @cached_property
    def _was_occupied(self) -> NDArray[np.bool_]:
        """Every n-th pixel whose surface was there before."""
        return self._appeared_pixels.was_occupied.numpy()

    @cached_property
    def _possibly_new(self) -> NDArray[np.bool_]:
        """Every n-th pixel with depth whose surface is not known to have been there before."""
        return ~(self._was_occupied | self._view.missing.numpy()[:: self._stride, :: self._stride])

    @cached_property
    def _continuous(self) -> NDArray[np.bool_]:
        """Every n-th pixel without an edge whose surface is not known to have been there before."""
        smooth = find_smooth_pixels(self._view.depth[0].numpy(), self._stride, self._config.edge_ratio)
        return smooth & ~(self._concave | self._was_occupied)

    @cached_property
    def _static_surface(self) -> NDArray[np.bool_]:
        """Every n-th pixel within reach of a person's mask whose surface an earlier view shows as static."""
        masks = np.zeros(self._concave.shape, np.bool_)
        for track in self._people:
            masks |= track.mask.numpy()[:: self._stride, :: self._stride]
        if not len(self._appeared_pixels.was_free):  # the pose relative to earlier views is not known
            return np.zeros_like(masks)
        reachable = _dilate(masks, self._reach // self._stride) & self._continuous
        reachable |= _dilate(masks, self._config.depth_margin // self._stride + 1)
        reachable &= ~(masks | self._appeared_pixels.appeared.numpy())
        return self._static_surfaces.find(self._view, torch.from_numpy(reachable), self._stride).numpy()

    def refine(self, track: Track) -> RefinedMask:
        """Return the refined mask of one of the objects."""
        crop = crop_around(track.mask.view(torch.uint8).numpy(), self._reach, self._step)
        if crop is None:
            nothing = np.zeros((0, 0), np.bool_)
            return RefinedMask((slice(0, 0), slice(0, 0)), nothing, nothing)
        surface = self._surface(track, crop)
        if track.missed or track not in self._silhouettes:
            return RefinedMask(crop, surface, surface)
        return RefinedMask(crop, surface, self._with_other_parts(track, surface, crop))

    def _surface(self, track: Track, crop: Crop) -> NDArray[np.bool_]:
        """Return the pixels of an object in a part of the image that contains all of them, shape (h, w)."""
        config, segmented, cloud_pixels = self._config, track.mask.numpy()[crop], track.cloud_pixels[crop]
        if track not in self._silhouettes:  # too few points for a depth range of the object
            # A predicted mask already agrees with the depth; without points it is the last one.
            is_predicted = track.missed and len(track.newest.cloud) > 0
            return segmented if is_predicted else _dilate(segmented, config.depth_margin)
        silhouette, tolerance = self._silhouettes[track][0], self._tolerance(track)
        depth, origin = self._view.depth[:, *crop].contiguous(), (crop[0].start, crop[1].start)
        reachable = silhouette.mask(depth, config.surface_margin, tolerance, origin=origin)
        cells = self._cells(crop)
        # A thing that moves now was a static surface before, but views are stored without people.
        static = self._static_surface[cells] & (track.label == PERSON)
        mask = self._grow_surface(segmented, cloud_pixels, reachable, static, cells)
        if track.missed:  # a predicted mask already agrees with the depth
            mask |= segmented
            return mask
        agreeing = silhouette.mask(depth, config.depth_margin, tolerance, origin=origin).numpy()
        agreeing |= self._view.missing.numpy()[crop]
        agreeing &= _dilate(segmented, config.depth_margin)
        if static.any():
            excluded = upsample_nearest(static, self._stride, mask.shape).numpy() > segmented
            np.greater(agreeing, excluded, out=agreeing)  # a & ~b without a copy of b
        mask |= agreeing
        mask |= cloud_pixels.numpy()
        return mask

    def _tolerance(self, track: Track) -> float:
        """Return the maximum depth difference between a pixel and the points of an object around it, metres."""
        return self._config.depth_tolerance + _INVERSE_DEPTH_TOLERANCE * self._silhouettes[track][1] ** 2

    def _with_other_parts(self, track: Track, surface: NDArray[np.bool_], crop: Crop) -> NDArray[np.bool_]:
        """Return an object's pixels and other parts of the network's mask, bool, shape (h, w).

        Parts that are not known to have been there before are kept, because they can be a second person: a network
        sometimes draws one mask over two people. Parts that belonged to the object at its previous detection are kept,
        because its points can be those of an arm far in front of the body, without the body.
        """
        stride, segmented = self._stride, track.mask.numpy()[crop]
        parts = _wide_parts(segmented[::stride, ::stride] & ~surface[::stride, ::stride], stride)
        if parts.any():  # seldom; the rest takes longer
            parts &= self._possibly_new[self._cells(crop)] | self._previous_surface(track, crop)
            parts = _wide_parts(parts, stride)
        if not parts.any():
            return surface
        pixels = upsample_nearest(parts, stride, surface.shape).numpy()
        return surface | (pixels & segmented & ~self._view.missing.numpy()[crop])

    def _previous_surface(self, track: Track, crop: Crop) -> NDArray[np.bool_]:
        """Return every n-th pixel of a part of the image that shows the points of an object's previous detection."""
        depth = self._view.depth[:, *crop][:, :: self._stride, :: self._stride]
        cloud = track.predict_previous_cloud()
        if cloud is None:
            return np.zeros(depth.shape[1:], np.bool_)
        silhouette = silhouettes([transform_points(self._view.T_dw, cloud)], self._camera, self._spacing)[0]
        origin = crop[0].start, crop[1].start
        return silhouette.mask(depth, 0, self._tolerance(track), stride=self._stride, origin=origin).numpy()

    def _grow_surface(
        self,
        segmented: NDArray[np.bool_],
        cloud_pixels: Tensor,
        reachable: Tensor,
        static: NDArray[np.bool_],
        cells: Crop,
    ) -> NDArray[np.bool_]:
        """Grow an object's pixels within the reachable ones up to the next edge or static surface, bool, (h, w)."""
        if self._config.surface_margin == 0:
            return (cloud_pixels & reachable).numpy()
        stride = self._stride
        seeds = cloud_pixels.numpy()[::stride, ::stride]
        near = _dilate(segmented[::stride, ::stride], self._config.surface_margin // stride)
        near &= reachable.numpy()[::stride, ::stride]
        near &= self._continuous[cells] & ~static
        near |= seeds & ~self._concave[cells]
        fraction = self._config.min_surface_fraction
        return _fill_surfaces(torch.from_numpy(near), cloud_pixels, reachable, stride, fraction).numpy()

    def _cells(self, crop: Crop) -> Crop:
        """Return the rows and columns of the coarse images that show a part of the image."""
        rows, columns = (slice(each.start // self._stride, each.stop // self._stride) for each in crop)
        return rows, columns


def _dilate(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    return dilate(torch.from_numpy(np.ascontiguousarray(mask)), pixels).numpy()


def _wide_parts(cells: NDArray[np.bool_], stride: int) -> NDArray[np.bool_]:
    """Remove narrow parts from coarse pixels of the network's mask, (h, w): they are background along its contour."""
    kernel = ellipse(max(_MIN_PART_RADIUS // stride, _MIN_COARSE_RADIUS))
    return cv2.morphologyEx(cells.view(np.uint8), cv2.MORPH_OPEN, kernel).view(np.bool_)


def _components(region: NDArray[np.uint8]) -> tuple[int, NDArray[np.int32], Crop]:
    """Return the number of connected components, and the component of each cell in the returned rows and columns."""
    # Crop to the region, with a margin of one cell for the final dilation; OpenCV needs at least one cell.
    crop = crop_around(region, 1) or (slice(0, 1), slice(0, 1))
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
