"""Edges at which a surface ends: depth edges, and concave edges.

Where two objects touch, the depth has no step, but the surface bends towards the camera, as where a foot stands on the
floor. The surface of one body is mostly convex (Stein et al., "Object Partitioning using Local Convexity", CVPR 2014).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from v3d_torch.kernels import surface_edges as kernels
from v3d_torch.kernels.compiler import compiled_by
from v3d_torch.objects.depth_view import erode_measured

_REACH, _DIAGONAL_REACH = 3, 2
"""Distance at which a bend is measured along rows and columns, and along each of them on a diagonal, cells: over a
shorter distance the depth noise is larger than the bend."""

_MIN_BEND = 0.012
"""Second difference of the inverse depth at a concave edge, 1/m. A foot on the floor, 1.4 m below a camera with a focal
length of 525 pixels, has 0.016 at any distance; the standard deviation on smoothed images of a Kinect is 0.005."""


def _find_smooth_pixels_compiled(depth: NDArray[np.float32], stride: int, edge_ratio: float) -> NDArray[np.bool_]:
    if depth.dtype != np.float32:
        return NotImplemented
    return kernels.find_smooth_pixels(np.ascontiguousarray(depth), stride, edge_ratio)


@compiled_by(_find_smooth_pixels_compiled)
def find_smooth_pixels(depth: NDArray[np.float32], stride: int, edge_ratio: float) -> NDArray[np.bool_]:
    """Check at every n-th pixel whether the depth within half the stride of it varies by less than ``edge_ratio``.

    Args:
        depth: Depth, metres, shape :math:`(H, W)`; 0 = no measurement.
        stride: Step n between the pixels.
        edge_ratio: Largest variation of the depth, as a fraction of the depth.

    Returns:
        Bool, shape :math:`(h, w)`.
    """
    size, centre = stride + 1, depth[::stride, ::stride]
    nearest = erode_measured(depth, size)[::stride, ::stride]
    farthest = cv2.dilate(depth, np.ones((size, size), np.uint8))[::stride, ::stride]
    return np.asarray((centre > 0) & (farthest - nearest < edge_ratio * centre), np.bool_)


def _find_concave_edges_compiled(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    if depth.dtype != np.float32:
        return NotImplemented
    return kernels.find_concave_edges(depth, _REACH, _DIAGONAL_REACH, _MIN_BEND)


@compiled_by(_find_concave_edges_compiled)
def find_concave_edges(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Find the cells at which the depth bends towards the camera along rows, columns or diagonals.

    The inverse depth of a plane is linear in the image, so its second difference is 0 on a plane at any tilt, and
    positive at a concave edge, and behind the contour of a nearer object. Rows and columns alone would cross the edges
    in the image of a rolled camera at half a right angle, which makes the difference smaller.

    Args:
        depth: Depth of each cell, metres, shape :math:`(h, w)`; 0 = no measurement.

    Returns:
        Bool, shape :math:`(h, w)`; in a direction in which the border of the image is nearer than the reach, or a cell
        has no depth, no edge is found.
    """
    inverse = 1 / np.where(depth > 0, depth, np.float32(np.nan))
    edges = np.zeros(depth.shape, np.bool_)
    for w, along_axis in ((inverse, edges), (inverse.T, edges.T)):
        before, centre, after = w[: -2 * _REACH], w[_REACH:-_REACH], w[2 * _REACH :]
        along_axis[_REACH:-_REACH] |= before + after - 2 * centre > _MIN_BEND
    inner = slice(_DIAGONAL_REACH, -_DIAGONAL_REACH)
    first, last = slice(-2 * _DIAGONAL_REACH), slice(2 * _DIAGONAL_REACH, None)
    for w, on_diagonal in ((inverse, edges), (inverse[:, ::-1], edges[:, ::-1])):
        on_diagonal[inner, inner] |= w[first, first] + w[last, last] - 2 * w[inner, inner] > _MIN_BEND
    return edges
