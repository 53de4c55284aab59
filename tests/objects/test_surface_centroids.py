"""Centroids of surfaces in masks against known surfaces and a mean of voxels by NumPy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from v3d_torch.config import CloudConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.objects.depth_view import DepthView
from v3d_torch.objects.surface_centroids import SurfaceCentroids

CAMERA = PinholeCamera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240)
T_WC = se3_exp(torch.tensor([0.4, -0.2, 0.1, 0.3, -0.5, 0.2], dtype=torch.float64))
WALL = 4.5
TABLE = 0.7
"""Distance of a table below the camera, metres."""


def view_of(depth: Tensor) -> DepthView:
    return DepthView(0.0, depth[None].float(), invert(T_WC))


def centroids(depth: Tensor, *masks: Tensor, stride: int = 2) -> list[Tensor | None]:
    """Return the centroids in the camera frame."""
    found = SurfaceCentroids(CloudConfig(stride=stride), CAMERA)(view_of(depth), masks)
    T_cw = invert(T_WC)
    return [None if each is None else T_cw[:3, :3] @ each + T_cw[:3, 3] for each in found]


def table() -> tuple[Tensor, Tensor]:
    """Return the depth of a table top from 1.6 to 3.4 m, in front of a wall, and its mask, (H, W) each."""
    ray = CAMERA.rays[..., 1].double()
    z = TABLE / ray.clamp(min=1e-6)
    mask = (z > 1.6) & (z < 3.4) & (CAMERA.rays[..., 0].abs() * z < 0.3)
    return torch.where(mask, z, WALL), mask


def test_near_and_far_parts_of_a_surface_count_the_same() -> None:
    """A table seen from 0.7 m above: pixels are denser on its near end, so that their mean is off by a decimetre."""
    depth = table()[0]
    near, far = 1.8, 2.8  # within 0.6 m of the median depth, so that no pixel is left out
    mask = (depth > near) & (depth < far)
    (centroid,) = centroids(depth, mask, stride=1)
    assert centroid is not None
    expected = torch.tensor([0.0, TABLE, (near + far) / 2], dtype=torch.float64)
    torch.testing.assert_close(centroid, expected, rtol=0.0, atol=0.03)
    assert abs(float(depth[mask].mean()) - (near + far) / 2) > 0.08


def test_centroid_is_the_mean_of_voxels() -> None:
    """Oracle: NumPy averages the points of each voxel, then the voxels."""
    generator = torch.Generator().manual_seed(0)
    depth = 2.0 + 0.5 * torch.rand(CAMERA.height, CAMERA.width, generator=generator, dtype=torch.float64)
    mask = torch.zeros(depth.shape, dtype=torch.bool)
    mask[60:180, 100:220] = True
    (centroid,) = centroids(depth, mask)
    chosen = mask[::2, ::2].numpy()
    points = (CAMERA.rays * depth[..., None]).float()[::2, ::2].numpy()[chosen]
    cells = np.floor(points / np.float32(0.05)).astype(int)
    _, voxel = np.unique(cells, axis=0, return_inverse=True)
    count = np.bincount(voxel.ravel())
    means = np.stack([np.bincount(voxel.ravel(), points[:, axis]) / count for axis in range(3)], axis=1)
    assert centroid is not None
    np.testing.assert_allclose(centroid.numpy(), means.mean(axis=0), atol=1e-6)


@pytest.mark.parametrize("beyond", [WALL, 0.5])
def test_pixels_of_other_surfaces_do_not_count(beyond: float) -> None:
    """A third of the mask shows the wall behind the object, or something near the camera."""
    mask = torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.bool)
    mask[60:180, 100:220] = True
    depth = torch.full(mask.shape, WALL, dtype=torch.float64)
    depth[mask] = 2.0
    (alone,) = centroids(depth, mask)
    coarse = mask.clone()
    coarse[60:180, 220:280] = True
    depth[coarse & ~mask] = beyond
    (centroid,) = centroids(depth, coarse)
    assert alone is not None and centroid is not None
    torch.testing.assert_close(centroid, alone, rtol=0.0, atol=1e-9)


def test_masks_without_depth_have_no_centroid_and_others_are_independent_of_them() -> None:
    depth, mask = table()
    depth[:, 200:] = 0.0
    empty, unknown = torch.zeros_like(mask), torch.zeros_like(mask)
    unknown[50:100, 220:300] = True
    together = centroids(depth, empty, mask, unknown)
    (alone,) = centroids(depth, mask)
    assert together[0] is None and together[2] is None
    assert alone is not None and together[1] is not None
    torch.testing.assert_close(together[1], alone, rtol=0.0, atol=1e-12)
    assert centroids(depth) == []
