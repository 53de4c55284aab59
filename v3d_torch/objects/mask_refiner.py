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
from v3d_torch.geometry.packed_masks import unpack_mask
from v3d_torch.geometry.se3 import transform_points
from v3d_torch.kernels import masks as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array
from v3d_torch.objects.appeared_pixels import AppearedPixels
from v3d_torch.objects.crops import Crop, box_of, crop_around, widen
from v3d_torch.objects.depth_view import DepthView
from v3d_torch.objects.dilation import dilate, ellipse, ellipse_heights
from v3d_torch.objects.resampling import subsample, upsample_nearest
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
        states = [track.predict_state(view.stamp) for track in with_centroid]
        clouds = predict_clouds(with_centroid, states, view.T_dw)
        median_depths = [float(cloud[:, 2].median()) for cloud in clouds]
        projected = silhouettes(clouds, camera, self._spacing)
        self._silhouettes = dict(zip(with_centroid, zip(projected, median_depths, strict=True), strict=True))

    @cached_property
    def _depth(self) -> Tensor:
        """Depth of every n-th pixel, metres, shape (1, h, w)."""
        return subsample(self._view.depth, self._stride)

    @cached_property
    def _concave(self) -> NDArray[np.bool_]:
        """Concave edges, at every n-th pixel."""
        return find_concave_edges(self._depth[0].numpy())

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
        packed = np.bitwise_or.reduce([track.coarse_mask.numpy() for track in self._people])
        masks = unpack_mask(torch.from_numpy(packed), self._concave.shape).numpy()
        if not len(self._appeared_pixels.was_free):  # the pose relative to earlier views is not known
            return np.zeros_like(masks)
        reachable = _dilate(masks, self._reach // self._stride) & self._continuous
        reachable |= _dilate(masks, self._config.depth_margin // self._stride + 1)
        reachable &= ~(masks | self._appeared_pixels.appeared.numpy())
        return self._static_surfaces.find(self._view, torch.from_numpy(reachable), self._stride).numpy()

    def refine(self, track: Track) -> RefinedMask:
        """Return the refined mask of one of the objects."""
        around = crop_around(track.mask.view(torch.uint8).numpy(), 0)
        if around is None:
            nothing = np.zeros((0, 0), np.bool_)
            return RefinedMask((slice(0, 0), slice(0, 0)), nothing, nothing)
        crop = widen(around, self._reach, self._step)
        if track not in self._silhouettes:  # too few points for a depth range of the object
            # A predicted mask already agrees with the depth; without points it is the last one.
            is_predicted = track.missed and len(track.newest.cloud) > 0
            segmented = track.mask.numpy()[crop]
            surface = segmented if is_predicted else _dilate(segmented, self._config.depth_margin)
            return RefinedMask(crop, surface, surface)
        # A thing that moves now was a static surface before, but views are stored without people.
        static = self._static_surface if track.label == PERSON else np.zeros_like(self._concave)
        surface = self._grow_surface(track, crop, static)
        if track.missed:  # a predicted mask already agrees with the depth
            surface |= track.mask.numpy()[crop]
            return RefinedMask(crop, surface, surface)
        near = widen(around, self._config.depth_margin, self._step)
        near_surface = _part(surface, crop, near)
        near_surface |= self._agreeing_pixels(track, near, static)
        return RefinedMask(crop, surface, self._with_other_parts(track, surface, crop))

    def _agreeing_pixels(self, track: Track, crop: Crop, static: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return the pixels near an object's mask whose depth agrees with the object or is missing, bool, (h, w)."""
        margin, cells = self._config.depth_margin, torch.from_numpy(static[self._cells(crop)])
        agreeing, masks = self._near_silhouette(track, crop, margin), (track.mask, track.cloud_pixels)
        return _select_agreeing(agreeing, self._view.depth[0], *masks, crop, cells, self._stride, margin).numpy()

    def _near_silhouette(self, track: Track, crop: Crop, margin: int) -> Tensor:
        """Return the pixels of a part of the image around an object's points with their depth, bool, (h, w)."""
        return self._silhouettes[track][0].mask(self._view.depth, margin, self._tolerance(track), crop=crop)

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
        cells, cloud = self._cells(crop), track.predict_previous_cloud()
        if cloud is None:
            return np.zeros_like(self._concave[cells])
        silhouette = silhouettes([transform_points(self._view.T_dw, cloud)], self._camera, self._spacing)[0]
        return silhouette.mask(self._depth, 0, self._tolerance(track), stride=self._stride, crop=cells).numpy()

    def _grow_surface(self, track: Track, crop: Crop, static: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Grow an object's pixels up to the next edge or static surface in a part of the image, bool, (h, w)."""
        config, stride, cells = self._config, self._stride, self._cells(crop)
        reachable, cloud_pixels = self._near_silhouette(track, crop, config.surface_margin), track.cloud_pixels[crop]
        if config.surface_margin == 0:
            return (cloud_pixels & reachable).numpy()
        seeds = cloud_pixels.numpy()[::stride, ::stride]
        near = _dilate(track.mask.numpy()[crop][::stride, ::stride], config.surface_margin // stride)
        near &= reachable.numpy()[::stride, ::stride]
        near &= self._continuous[cells] & ~static[cells]
        near |= seeds & ~self._concave[cells]
        fraction = config.min_surface_fraction
        return _fill_surfaces(torch.from_numpy(near), cloud_pixels, reachable, stride, fraction).numpy()

    def _cells(self, crop: Crop) -> Crop:
        """Return the rows and columns of the coarse images that show a part of the image."""
        rows, columns = (slice(each.start // self._stride, each.stop // self._stride) for each in crop)
        return rows, columns


def _dilate(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    return dilate(torch.from_numpy(np.ascontiguousarray(mask)), pixels).numpy()


def _part(pixels: NDArray[np.bool_], crop: Crop, part: Crop) -> NDArray[np.bool_]:
    """Return a part of the image from the pixels of a larger one."""
    rows, columns = (
        slice(inner.start - outer.start, inner.stop - outer.start) for inner, outer in zip(part, crop, strict=True)
    )
    return pixels[rows, columns]


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
    seeds = pixels.view(torch.uint8).numpy()[::stride, ::stride][rows, columns]
    can_reach = to_array(reachable.view(torch.uint8))
    surface, origin = np.zeros_like(can_reach), (stride * rows.start, stride * columns.start)
    kernels.fill_components(components, count, seeds, can_reach, *origin, stride, min_fraction, surface)
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


def _select_agreeing_compiled(
    agreeing: Tensor,
    depth: Tensor,
    mask: Tensor,
    cloud_pixels: Tensor,
    crop: Crop,
    static: Tensor,
    stride: int,
    margin: int,
) -> Tensor:
    heights = ellipse_heights(margin)
    if heights is None or depth.dtype != torch.float32:
        return NotImplemented
    agrees, own, on_object = (to_array(each.view(torch.uint8)) for each in (agreeing, mask, cloud_pixels))
    box, cells = box_of(crop, depth.shape), static.view(torch.uint8).numpy()
    selected = kernels.select_agreeing(agrees, to_array(depth), own, on_object, box, cells, stride, heights)
    return torch.from_numpy(selected).view(torch.bool)


@compiled_by(_select_agreeing_compiled)
def _select_agreeing(
    agreeing: Tensor,
    depth: Tensor,
    mask: Tensor,
    cloud_pixels: Tensor,
    crop: Crop,
    static: Tensor,
    stride: int,
    margin: int,
) -> Tensor:
    """Select the pixels near the mask of an object that agree with the object or have no depth.

    Args:
        agreeing: Pixels of a part of the image whose depth agrees with the object's points, bool, shape :math:`(h, w)`.
        depth: Depth, metres, float32, shape :math:`(H, W)`; 0 = no measurement.
        mask: Network's mask of the object, bool, shape :math:`(H, W)`.
        cloud_pixels: Pixels of the object's points; they are always selected, bool, shape :math:`(H, W)`.
        crop: Rows and columns of the part, which begins at multiples of the stride.
        static: Cells of the part that show static surfaces, bool; only the mask is selected there.
        stride: Side of a cell, pixels.
        margin: Radius by which the mask is dilated, pixels.

    Returns:
        Selected pixels of the part, bool, shape :math:`(h, w)`.
    """
    segmented = mask.numpy()[crop]
    excluded = upsample_nearest(static.numpy(), stride, segmented.shape).numpy() & ~segmented
    selected = (agreeing.numpy() | (depth.numpy()[crop] <= 0)) & _dilate(segmented, margin) & ~excluded
    return torch.from_numpy(selected | cloud_pixels.numpy()[crop])
