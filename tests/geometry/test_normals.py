"""Surface normals against known surfaces."""

from __future__ import annotations

import pytest
import torch
from helpers.box_room import CAMERA
from torch import Tensor

from v3d_torch.errors import ConfigError
from v3d_torch.geometry.camera import back_project
from v3d_torch.geometry.depth_smoother import smooth_depth
from v3d_torch.geometry.normals import surface_normals


def slanted(normal: list[float], distance: float) -> tuple[Tensor, Tensor]:
    """Points of a plane per pixel, (1, H, W, 3), and the unit normal towards the camera."""
    n = torch.nn.functional.normalize(torch.tensor(normal, dtype=torch.float64), dim=0)
    rays = CAMERA.rays.to(torch.float64)
    z = -distance / (rays @ n)
    assert (z > 0).all()
    return (z[..., None] * rays)[None], n


@pytest.mark.parametrize("normal", [[0, 0, -1], [0.6, 0, -1], [-0.5, 0.4, -1], [0.1, -0.9, -1]])
@pytest.mark.parametrize("radius", [0, 1, 4])
def test_convention_normals_of_a_plane_point_to_the_camera(normal: list[float], radius: int) -> None:
    """Also next to the image border and next to pixels without depth."""
    points, n = slanted(normal, 2.0)
    points[:, 100:110, 60:] = 0
    normals = surface_normals(points, radius)[0]
    known = torch.zeros(240, 320, dtype=torch.bool)
    known[1:-1, 1:-1] = True
    known[99:111, 59:] = False
    known[99:111, 59] = torch.tensor([True, *10 * [False], True])
    torch.testing.assert_close(normals, torch.where(known[..., None], n, 0.0), rtol=0, atol=1e-9)


def test_normals_of_a_batch_equal_normals_of_each_image() -> None:
    batch = torch.cat([slanted([0, 0, -1], 1.0)[0], slanted([0.5, 0.1, -1], 2.0)[0]])
    normals = surface_normals(batch)
    for points, expected in zip(batch, normals, strict=True):
        assert torch.equal(surface_normals(points[None])[0], expected)


def test_edges_and_holes_have_no_normals() -> None:
    depth = torch.full((1, 240, 320), 2.0)
    depth[0, :, 160:] = 3.0
    depth[0, 50, 50] = 0.0
    none = (surface_normals(back_project(depth[None], CAMERA.rays))[0] == 0).all(dim=-1)[1:-1, 1:-1]
    expected = torch.zeros(240, 320, dtype=torch.bool)
    expected[:, 159:161] = True
    expected[[50, 49, 51, 50, 50], [50, 50, 50, 49, 51]] = True
    assert torch.equal(none, expected[1:-1, 1:-1])


@pytest.mark.parametrize("radius", [0, 1])
@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
def test_gradients_beside_points_that_are_not_finite_are_those_beside_holes(value: float, radius: int) -> None:
    plane, weights = slanted([0.5, 0.1, -1], 2.0)[0][:, 100:120, 100:130], torch.arange(1800.0).reshape(1, 20, 30, 3)
    gradients = []
    for hole in (value, 0.0):
        points = plane.clone()
        points[0, 5, 5] = points[0, 10, 7:9] = hole
        normals = surface_normals(points.requires_grad_(), radius)
        gradients += torch.autograd.grad((normals * weights).sum(), points)
    assert gradients[0][0, 5, 7].any()
    assert torch.equal(*gradients)


@pytest.mark.parametrize(("distance", "degrees"), [(1.0, 1.5), (2.0, 3.0), (4.0, 6.0)])
def test_normals_of_a_wall_with_kinect_noise_are_accurate(distance: float, degrees: float) -> None:
    """Noise and quantisation of disparity after Khoshelham and Elberink (Sensors 2012)."""
    generator = torch.Generator().manual_seed(0)
    points, n = slanted([0.5, 0.2, -1], distance)
    z = points[..., 2]
    z = z + 0.0014 * z.square() * torch.randn(z.shape, generator=generator)
    z = 1 / (0.00285 * (1 / (0.00285 * z)).round())
    smooth = smooth_depth(z[:, None].float())
    normals = surface_normals(back_project(smooth, CAMERA.rays))[0].double()
    valid = (normals != 0).any(dim=-1)
    angle = torch.rad2deg(torch.arccos((normals[valid] @ n).clamp(max=1)))
    assert angle.quantile(0.9) < degrees
    assert valid.double().mean() > 0.95


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_negative_radius_is_rejected(dtype: torch.dtype) -> None:
    with pytest.raises(ConfigError, match=r"^radius is -1; give a number of pixels of at least 0$"):
        surface_normals(torch.ones(1, 9, 9, 3, dtype=dtype), radius=-1)
