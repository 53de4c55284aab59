"""Kernels of masks, surfaces, silhouettes and depths equal their torch twins, on random and degenerate inputs."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from v3d_torch.config import FreeSpaceConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.distortion import DistortionModel
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.kernels import compiler
from v3d_torch.kernels.compiler import TWINS
from v3d_torch.kernels.masks import Box
from v3d_torch.objects import mask_refiner, silhouette, static_surfaces, surface_edges
from v3d_torch.objects.depth_view import DepthView, StoredView

pytestmark = pytest.mark.skipif(not compiler.ENABLED, reason="numba is not installed, or V3D_KERNELS=torch is set")

SIZES = [(1, 1), (1, 7), (9, 1), (13, 30), (48, 64)]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("density", [0.0, 0.02, 0.5, 1.0])
@pytest.mark.parametrize("radius", [0, 1, 3, 8, 100])
def test_dilation_equals_its_twin(size: tuple[int, int], density: float, radius: int) -> None:
    twin = TWINS["v3d_torch.objects.dilation.dilate"]
    mask = torch.from_numpy(np.random.default_rng(0).random(size) < density)
    assert torch.equal(twin.compiled(mask, radius), twin.torch(mask, radius))


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("measured", [0.0, 0.7, 1.0])
@pytest.mark.parametrize("radius", [0, 1, 2, 6, 70])
def test_nearest_depth_equals_its_twin(size: tuple[int, int], measured: float, radius: int) -> None:
    twin = TWINS["v3d_torch.objects.depth_view._nearest_depth"]
    depth = random_depth(size, measured)[0]
    assert torch.equal(twin.compiled(depth, radius), twin.torch(depth, radius))


@pytest.mark.parametrize("density", [0.0, 0.3, 0.6, 1.0])
@pytest.mark.parametrize("step", [1, 3, 4])
def test_filled_surfaces_equal_their_twin(density: float, step: int) -> None:
    twin, rng = TWINS[f"{mask_refiner.__name__}._fill_surfaces"], np.random.default_rng(0)
    pixels, reachable = (torch.from_numpy(rng.random((45, 62)) < d) for d in (0.5, 0.9))
    region = torch.from_numpy(rng.random((-(-45 // step), -(-62 // step))) < density)
    found, expected = (f(region, pixels, reachable, step, 0.4) for f in twin)
    assert torch.equal(found, expected)


@pytest.mark.parametrize("crop", [(0, 48, 0, 64), (8, 24, 16, 60), (40, 52, 60, 68)])
@pytest.mark.parametrize("measured", [0.0, 0.7])
@pytest.mark.parametrize("step", [1, 2, 4])
@pytest.mark.parametrize("margin", [0, 8, 40])
def test_agreeing_pixels_equal_their_twin(
    crop: tuple[int, int, int, int], measured: float, step: int, margin: int
) -> None:
    rng = np.random.default_rng(0)
    top, bottom, left, right = crop
    part = slice(top, bottom), slice(left, right)
    mask, cloud_pixels, agreeing = (torch.from_numpy(rng.random((48, 64)) < d) for d in (0.02, 0.01, 0.5))
    static = torch.from_numpy(rng.random((-(-(bottom - top) // step), -(-(right - left) // step))) < 0.5)
    depth = random_depth((48, 64), measured)[0]
    found, expected = (
        f(agreeing[part].contiguous(), depth, mask, cloud_pixels, part, static, step, margin)
        for f in TWINS[f"{mask_refiner.__name__}._select_agreeing"]
    )
    assert torch.equal(found, expected)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("measured", [0.0, 0.7, 1.0])
@pytest.mark.parametrize("step", [1, 3, 4])
def test_edges_of_surfaces_equal_their_twins(size: tuple[int, int], measured: float, step: int) -> None:
    depth, name = random_depth(size, measured)[0].numpy(), surface_edges.__name__
    for edge_ratio in (0.04, 0.15):
        np.testing.assert_array_equal(*(f(depth, step, edge_ratio) for f in TWINS[f"{name}.find_smooth_pixels"]))
    for part in (depth, depth[::step, ::step]):
        np.testing.assert_array_equal(*(f(part) for f in TWINS[f"{name}.find_concave_edges"]))


@pytest.mark.parametrize("views", [0, 1, 3])
@pytest.mark.parametrize(("density", "measured"), [(0.0, 1.0), (0.5, 0.0), (0.5, 0.7), (1.0, 1.0)])
@pytest.mark.parametrize("step", [1, 3, 4])
def test_static_surfaces_equal_their_twin(views: int, density: float, measured: float, step: int) -> None:
    rng = np.random.default_rng(0)
    camera = PinholeCamera(52.0, 52.0, 31.5, 23.5, 64, 48, distortion=(0.26, -0.95, -0.005, 0.003, 1.2))
    poses = se3_exp(torch.from_numpy(rng.normal(0, 0.1, (views + 1, 6))))
    scales = torch.from_numpy(rng.choice([0.7, 1.0, 1.3], (views, 48, 64)).astype(np.float32))
    nearest = random_depth((48, 64), measured) * scales  # points are hidden, on a surface, or in free space
    earlier = [StoredView(0.0, depth, pose) for depth, pose in zip(nearest, poses, strict=False)]
    view = DepthView(1.0, random_depth((48, 64), measured), poses[-1])
    pixels = torch.from_numpy(rng.random((-(-48 // step), -(-64 // step))) < density)
    found, expected = (
        f(view, pixels, step, earlier, camera, FreeSpaceConfig()) for f in TWINS[f"{static_surfaces.__name__}._find"]
    )
    assert torch.equal(found, expected)
    assert bool(found.any()) is (views > 0 and density > 0 and measured > 0)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("filled", [0.0, 0.1, 1.0])
@pytest.mark.parametrize("radius", [0, 1, 3, 8, 20])
def test_minima_around_cells_equal_their_twin(size: tuple[int, int], filled: float, radius: int) -> None:
    rng = np.random.default_rng(0)
    minima = np.where(rng.random((*size, 1)) < filled, rng.normal(0, 2, (*size, 2)), 1e6).astype(np.float32)
    found, expected = (f(minima, radius) for f in TWINS[f"{silhouette.__name__}._minima_around"])
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("count", [0, 1, 500])
def test_counted_points_equal_their_twin(count: int) -> None:
    rng, depth = np.random.default_rng(0), random_depth((47, 62), 0.8)
    cells, z = rng.integers(0, (16, 12), (count, 2)), rng.normal(2, 0.2, count).astype(np.float32)
    found, expected = (f(cells, z, depth, 0.2) for f in TWINS[f"{silhouette.__name__}._count_points"])
    assert found == expected


@pytest.mark.parametrize("step", [1, 3, 4])
@pytest.mark.parametrize("first", [(0, 0), (-3, 2), (14, 9), (-20, -20), (40, 40)])
@pytest.mark.parametrize("include_missing", [False, True])
@pytest.mark.parametrize("box", [None, (3, 11, 2, 16), (5, 5, 4, 9)])
def test_selected_pixels_equal_their_twin(
    step: int, first: tuple[int, int], include_missing: bool, box: Box | None
) -> None:
    rng = np.random.default_rng(0)
    nearest = rng.choice([1.5, 2.0, 1e6], (6, 8)).astype(np.float32)
    farthest = np.where(nearest < 1e6, nearest + rng.uniform(0, 0.1, (6, 8)), -1e6)
    minima = np.stack([nearest, -farthest], axis=-1).astype(np.float32)
    depth = random_depth((48, 64), 0.8)[:, ::step, ::step]
    whole = 0, depth.shape[1], 0, depth.shape[2]
    twin, (top, bottom, left, right) = TWINS[f"{silhouette.__name__}._select_pixels"], box or whole
    found, expected = (f(minima, first, depth, box or whole, 0.2, step, include_missing) for f in twin)
    everywhere = twin.torch(minima, first, depth, whole, 0.2, step, include_missing)
    assert torch.equal(found, expected) and torch.equal(found, everywhere[top:bottom, left:right])


@pytest.mark.parametrize(
    ("distortion", "model"),
    [
        ((), "plumb_bob"),
        ((0.2624, -0.9531, -0.0054, 0.0026, 1.1633), "plumb_bob"),
        ((0.45, -2.5, 0.0006, -0.0003, 1.4, 0.33, -2.3, 1.4), "rational_polynomial"),
        ((-0.01, 0.02, -0.01, 0.002), "equidistant"),
    ],
)
def test_projected_cloud_equals_its_twin(distortion: tuple[float, ...], model: DistortionModel) -> None:
    camera = PinholeCamera(52.0, 52.0, 31.5, 23.5, 64, 48, distortion=distortion, distortion_model=model)
    rng = np.random.default_rng(0)
    clouds = [torch.from_numpy(rng.normal(0, 2, (count, 3))) for count in (0, 1, 1000)]
    clouds.append(torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [torch.nan, 0.0, 1.0]], dtype=torch.float64))
    for cloud in clouds:
        found, expected = (f(cloud, camera) for f in TWINS[f"{silhouette.__name__}._project"])
        for each, expected_each in zip(found, expected, strict=True):
            np.testing.assert_array_equal(each, expected_each)


def random_depth(size: tuple[int, int], measured: float) -> torch.Tensor:
    """Depth near 2 m, shape (1, H, W); 0 for a part of the pixels."""
    rng = np.random.default_rng(1)
    depth = rng.normal(2, 0.1, size) * (rng.random(size) < measured)
    return torch.from_numpy(depth.astype(np.float32))[None]
