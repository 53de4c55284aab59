"""Triangle mesh of the static scene: marching cubes on a truncated signed distance function, tile by tile."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np
import torch
from skimage.measure import marching_cubes
from torch import Tensor
from torch.nn.functional import normalize, pad

from v3d_torch.config import DenseMapConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import transform_points
from v3d_torch.mapping.static_views import StaticView, StaticViews
from v3d_torch.reconstruction.tsdf import BLOCK, integrate, surface_blocks

_TILE = 16
"""Number of blocks along a side of a tile, 2.6 m at 2 cm per voxel: 2 million voxels are in memory at a time."""


@dataclass(frozen=True)
class Mesh:
    """Coloured triangle mesh.

    Attributes:
        vertices: Positions, world frame, metres, float32, shape :math:`(V, 3)`.
        faces: Vertex indices of each triangle, counterclockwise when viewed from free space, int64,
            shape :math:`(F, 3)`.
        normals: Unit normal of each vertex that points out of the surface, float32, shape :math:`(V, 3)`.
        colours: RGB of each vertex, uint8, shape :math:`(V, 3)`.
    """

    vertices: Tensor
    faces: Tensor
    normals: Tensor
    colours: Tensor


@torch.no_grad()
def fuse_mesh(views: StaticViews, config: DenseMapConfig) -> Mesh:
    """Fuse all views into a coloured triangle mesh: the zero level of their mean truncated signed distance.

    Args:
        views: Static views of the keyframes.
        config: Configuration of the dense map and the mesh.

    Returns:
        Mesh in the world frame; without vertices if no surface is seen.
    """
    blocks = surface_blocks(views, config)
    tile_vertices, tile_faces = [torch.zeros(0, 3, dtype=torch.float64)], [torch.zeros(0, 3, dtype=torch.int64)]
    count = 0
    for tile in blocks.div(_TILE, rounding_mode="floor").unique(dim=0):
        vertices, faces = _extract_tile(tile, blocks, views, config)
        tile_vertices.append(vertices)
        tile_faces.append(faces + count)
        count += len(vertices)
    # Adjacent tiles share the voxels of their common side, so that their vertices there are bit-identical.
    vertices, merged = torch.cat(tile_vertices).unique(dim=0, return_inverse=True)
    faces = merged[torch.cat(tile_faces)]
    faces = faces[(faces != faces.roll(1, dims=1)).all(dim=1)]  # drop triangles without area
    vertices = vertices * config.mesh.voxel_size
    used, faces = _drop_hidden(vertices, faces, views, config).unique(return_inverse=True)
    vertices = vertices[used]
    normals = _vertex_normals(vertices, faces)
    colours = _vertex_colours(vertices, normals, faces, views, config)
    return Mesh(vertices.to(torch.float32), faces, normals.to(torch.float32), colours)


def _extract_tile(tile: Tensor, blocks: Tensor, views: StaticViews, config: DenseMapConfig) -> tuple[Tensor, Tensor]:
    """Surface in a tile: vertices in voxels from the world's origin, float64, (V, 3), and triangles, (F, 3)."""
    positions = blocks - tile * _TILE
    inside = ((positions >= 0) & (positions <= _TILE)).all(dim=1)  # including the first blocks of the next tiles
    positions = positions[inside]
    distances, weights = integrate(blocks[inside], views, config)
    volume, measured = (_assemble(values, positions) for values in (distances, weights > 0))
    cubes = measured  # cubes whose eight corners are measured
    for axis in range(3):
        cubes = cubes.narrow(axis, 0, measured.shape[axis] - 1) & cubes.narrow(axis, 1, measured.shape[axis] - 1)
    empty = torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, 3, dtype=torch.int64)
    if not (cubes.any() and volume[measured].min() < 0 < volume[measured].max()):
        return empty
    # marching_cubes reads the mask of a cube at its last corner. Distances increase towards the front of the triangles.
    mask = pad(cubes, (1, 0, 1, 0, 1, 0)).numpy()
    try:
        vertices, faces, _, _ = marching_cubes(volume.numpy(), 0.0, gradient_direction="descent", mask=mask)
    except RuntimeError:  # no surface in any measured cube
        return empty
    origin = (tile * _TILE * BLOCK).to(torch.float64)
    return torch.from_numpy(vertices.astype(np.float64)) + origin, torch.from_numpy(faces.astype(np.int64))


def _assemble(values: Tensor, positions: Tensor) -> Tensor:
    """Dense volume of the blocks at their positions in a tile; 0 where no block is."""
    sides = positions.amax(dim=0) + 1
    box = values.new_zeros(*sides.tolist(), BLOCK, BLOCK, BLOCK)
    box[tuple(positions.unbind(dim=1))] = values
    # Only the first layer of voxels of the next tiles is used, for the cubes between two tiles.
    x, y, z = (BLOCK * sides).clamp(max=BLOCK * _TILE + 1).tolist()
    return box.permute(0, 3, 1, 4, 2, 5).reshape((BLOCK * sides).tolist())[:x, :y, :z].contiguous()


def _drop_hidden(vertices: Tensor, faces: Tensor, views: StaticViews, config: DenseMapConfig) -> Tensor:
    """Drop the triangles that no view observes from the front, (F, 3) to (f, 3).

    They form a layer behind the surface: where views disagree by more than the truncation distance, as at depth edges,
    voxels behind the surface of one view are free space of another.
    """
    centres, normals = vertices[faces].mean(dim=1), _area_normals(vertices, faces)
    hidden = torch.ones(len(faces), dtype=torch.bool)
    for view in views:
        rows = torch.nonzero(hidden)[:, 0]
        hidden[rows] = _observe(centres[rows], normals[rows], view, views.camera, config)[0] == 0
    return faces[~hidden]


def _area_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Normals of triangles, as long as twice their area, shape (F, 3)."""
    a, b, c = vertices[faces].unbind(dim=1)
    return torch.linalg.cross(b - a, c - a)


def _vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Mean normal of the triangles at each vertex, weighted by area, shape (V, 3)."""
    area_normals, sums = _area_normals(vertices, faces), torch.zeros_like(vertices)
    for corner in faces.unbind(dim=1):
        sums.index_add_(0, corner, area_normals)
    return normalize(sums, dim=1)


def _vertex_colours(
    vertices: Tensor, normals: Tensor, faces: Tensor, views: StaticViews, config: DenseMapConfig
) -> Tensor:
    """Mean colour of each vertex in the views that observe it from the front, uint8, shape (V, 3).

    A vertex that none observes, at the border of a triangle whose centre is observed, has the mean colour of its
    neighbours. Colours are fused per vertex and not per voxel, because there are far fewer vertices.
    """
    sums, weights = vertices.new_zeros(len(vertices), 3), vertices.new_zeros(len(vertices), 1)
    for view in views:
        weight, u, v = _observe(vertices, normals, view, views.camera, config)
        sums += weight[:, None] * view.colour[:, v, u].T
        weights += weight[:, None]
    is_unseen = weights[:, 0] == 0
    for start, end in permutations(faces.unbind(dim=1), 2):
        rows = torch.nonzero(is_unseen[start] & ~is_unseen[end])[:, 0]
        sums.index_add_(0, start[rows], sums[end[rows]])
        weights.index_add_(0, start[rows], weights[end[rows]])
    return torch.where(weights > 0, sums / weights, 0.0).round().to(torch.uint8)


def _observe(
    points: Tensor, normals: Tensor, view: StaticView, camera: PinholeCamera, config: DenseMapConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """Weights of points of the surface in a view, and their pixels (u, v), shape (N,) each.

    The weight is the inverse squared depth, and 0 where the view observes another surface, or this one from behind.
    """
    in_camera = transform_points(view.T_dw, points)
    pixels, inside = camera.project_to_image(in_camera, config.mesh.voxel_size)
    u, v = pixels.round().to(torch.int64).unbind(dim=1)
    u, v = torch.where(inside, u, 0), torch.where(inside, v, 0)
    z = in_camera[:, 2]
    depth = view.depth[v, u]
    is_front = ((view.T_wd[:3, 3] - points) * normals).sum(dim=1) > 0
    observed = inside & (depth > 0) & ((depth - z).abs() < config.mesh.truncation) & is_front
    return torch.where(observed, 1 / z.square(), 0.0), u, v
