"""A triangle mesh of what stands still: marching cubes through the truncated signed distances, tile by tile."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from skimage.measure import marching_cubes
from torch import Tensor
from torch.nn.functional import normalize, pad

from v3d_torch.config import DenseMapConfig
from v3d_torch.mapping.static_views import StaticViews
from v3d_torch.reconstruction.tsdf import BLOCK, integrate, surface_blocks

_TILE = 16
"""Blocks along a side of a tile, 2.6 m at 2 cm: a tile's 2 million voxels are what is in memory at a time."""


@dataclass(frozen=True)
class Mesh:
    """Triangles in colour.

    Attributes:
        vertices: world frame, metres, float32, shape :math:`(V, 3)`.
        faces: vertices of each triangle, counterclockwise as seen from free space, int64, shape :math:`(F, 3)`.
        normals: unit vectors out of the surface, one per vertex, float32, shape :math:`(V, 3)`.
        colours: RGB, one per vertex, uint8, shape :math:`(V, 3)`.
    """

    vertices: Tensor
    faces: Tensor
    normals: Tensor
    colours: Tensor


@torch.no_grad()
def fuse_mesh(views: StaticViews, config: DenseMapConfig) -> Mesh:
    """The surface on which the mean signed distance of all views is zero.

    Args:
        views: of keyframes.
        config: of the dense map.
    """
    blocks = surface_blocks(views, config)
    found_vertices, found_faces = [torch.zeros(0, 3, dtype=torch.float64)], [torch.zeros(0, 3, dtype=torch.int64)]
    count = 0
    for tile in blocks.div(_TILE, rounding_mode="floor").unique(dim=0):
        vertices, faces = _march(tile, blocks, views, config)
        found_vertices.append(vertices)
        found_faces.append(faces + count)
        count += len(vertices)
    # Neighbouring tiles share the voxels of the face between them: there they have the same vertices, bit for bit.
    vertices, same = torch.cat(found_vertices).unique(dim=0, return_inverse=True)
    faces = same[torch.cat(found_faces)]
    faces = faces[(faces != faces.roll(1, dims=1)).all(dim=1)]  # some have no area, where the surface meets a voxel
    vertices = vertices * config.mesh.voxel_size
    normals = _normals(vertices, faces)
    return Mesh(vertices.to(torch.float32), faces, normals.to(torch.float32), _colours(vertices, views, config))


def _march(tile: Tensor, blocks: Tensor, views: StaticViews, config: DenseMapConfig) -> tuple[Tensor, Tensor]:
    """Surface in a tile: vertices in voxels from the world's origin, float64, (V, 3), and triangles of them, (F, 3)."""
    places = blocks - tile * _TILE
    within = ((places >= 0) & (places <= _TILE)).all(dim=1)  # with the first voxels of the tiles behind it
    places = places[within]
    distances, weights = integrate(blocks[within], views, config)
    volume, known = (_assembled(values, places) for values in (distances, weights > 0))
    cubes = known
    for axis in range(3):
        cubes = cubes.narrow(axis, 0, known.shape[axis] - 1) & cubes.narrow(axis, 1, known.shape[axis] - 1)
    nothing = torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, 3, dtype=torch.int64)
    if not (cubes.any() and volume[known].min() < 0 < volume[known].max()):
        return nothing
    # The mask of a cube is at its last corner. Distances grow towards free space, where the triangles' front is.
    mask = pad(cubes, (1, 0, 1, 0, 1, 0)).numpy()
    try:
        vertices, faces, _, _ = marching_cubes(volume.numpy(), 0.0, gradient_direction="descent", mask=mask)
    except RuntimeError:  # no cube that is known has a surface in it
        return nothing
    first = (tile * _TILE * BLOCK).to(torch.float64)
    return torch.from_numpy(vertices.astype(np.float64)) + first, torch.from_numpy(faces.astype(np.int64))


def _assembled(values: Tensor, places: Tensor) -> Tensor:
    """Blocks put together at their places in a tile, up to the last; 0 where there is no block."""
    sides = places.amax(dim=0) + 1
    box = values.new_zeros(*sides.tolist(), BLOCK, BLOCK, BLOCK)
    box[tuple(places.unbind(dim=1))] = values
    # Of the tiles behind it a tile has the first layer of voxels, for the cubes in between.
    x, y, z = (BLOCK * sides).clamp(max=BLOCK * _TILE + 1).tolist()
    return box.permute(0, 3, 1, 4, 2, 5).reshape((BLOCK * sides).tolist())[:x, :y, :z].contiguous()


def _normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Of vertices: the mean of their triangles' normals, by area."""
    a, b, c = vertices[faces].unbind(dim=1)
    twice = torch.linalg.cross(b - a, c - a)
    sums = torch.zeros_like(vertices)
    for corner in faces.unbind(dim=1):
        sums.index_add_(0, corner, twice)
    return normalize(sums, dim=1)


def _colours(vertices: Tensor, views: StaticViews, config: DenseMapConfig) -> Tensor:
    """Mean colour of each vertex in the views that see it, nearer ones before farther ones; uint8, (V, 3).

    Vertices are a tenth of the voxels: colours are theirs alone, and not taken along through the voxels.
    """
    sums, weights = vertices.new_zeros(len(vertices), 3), vertices.new_zeros(len(vertices), 1)
    for view in views:
        in_camera = vertices @ view.T_cw[:3, :3].T + view.T_cw[:3, 3]
        pixels, inside = views.camera.project_to_image(in_camera, config.mesh.voxel_size)
        u, v = pixels.round().to(torch.int64).unbind(dim=1)
        u, v = torch.where(inside, u, 0), torch.where(inside, v, 0)
        z = in_camera[:, 2]
        depth = view.depth[v, u]
        seen = inside & (depth > 0) & ((depth - z).abs() < config.mesh.truncation)
        weight = torch.where(seen, 1 / z.square(), 0.0)[:, None]
        sums += weight * view.colour[:, v, u].T
        weights += weight
    return torch.where(weights > 0, sums / weights, 0.0).round().to(torch.uint8)
