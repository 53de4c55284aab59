"""Exactly rendered planes for dense alignment, from two poses with a known motion between them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from v3d_torch.config import DenseOdometryConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.depth_smoother import smooth_depth
from v3d_torch.geometry.se3 import invert, se3_exp, se3_log
from v3d_torch.odometry.dense_aligner import DenseAligner, DenseAlignment

LENS = PinholeCamera(517.3, 516.5, 318.6, 255.3, distortion=(0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
PINHOLE = replace(LENS, distortion=(0.0,) * 5)
ALL_PIXELS = torch.ones(480, 640, dtype=torch.bool)
IDENTITY = torch.eye(4, dtype=torch.float64)
MOTION = se3_exp(torch.tensor([0.03, -0.02, 0.025, 0.02, -0.03, 0.05], dtype=torch.float64))

Image = tuple[Tensor, Tensor]  # grey (1, H, W), depth (1, H, W)
Paint = Callable[[Tensor, int], Tensor]


def smooth_pattern(points: Tensor, plane: int) -> Tensor:
    """Smooth pattern with wavelengths from 0.1 to 0.6 m."""
    generator = torch.Generator().manual_seed(plane)
    waves = torch.randn(3, 12, generator=generator, dtype=torch.float64) * 18
    return 0.5 + 0.04 * torch.sin(points @ waves + plane).sum(dim=-1)


def uniform(points: Tensor, plane: int) -> Tensor:
    return torch.full(points.shape[:-1], 0.4 + 0.1 * plane, dtype=torch.float64)


def vertical_stripes(points: Tensor, plane: int) -> Tensor:
    return 0.5 + 0.2 * torch.sin(25 * points[..., 0])


CORNER = ((0.0, 0.0, 1.0, 2.5), (0.8, 0.0, 0.6, 1.9), (0.0, 0.9, 0.43, 1.7))
"""A wall ahead, one to the right, a floor: (normal, distance) of each plane."""
WALL = CORNER[:1]


def render(T_cw: Tensor, camera: PinholeCamera = LENS, planes: tuple = CORNER, paint: Paint = smooth_pattern) -> Image:
    """Exact image of planes: each ray is intersected with the nearest plane."""
    T_wc = invert(T_cw)
    directions = camera.rays.double() @ T_wc[:3, :3].T
    normals = torch.tensor([plane[:3] for plane in planes], dtype=torch.float64)
    normals = normals / normals.norm(dim=1, keepdim=True)
    distances = torch.tensor([plane[3] for plane in planes], dtype=torch.float64)
    depths = (distances - normals @ T_wc[:3, 3]) / (directions @ normals.T)
    depth, nearest = torch.where(depths > 0.1, depths, torch.inf).min(dim=-1)
    points = T_wc[:3, 3] + depth[..., None] * directions
    grey = torch.zeros_like(depth)
    for plane in range(len(planes)):
        grey[nearest == plane] = paint(points[nearest == plane], plane)
    return grey[None].float(), depth[None].float()


def noisy(image: Image, sigma: float = 0.01, seed: int = 0) -> Image:
    """Image with the noise of a colour camera and the disparity noise of a Kinect, depth re-estimated."""
    generator = torch.Generator().manual_seed(seed)
    grey, depth = image
    inverse = 1 / depth + 0.0014 * torch.randn(depth.shape, generator=generator)
    return grey + sigma * torch.randn(grey.shape, generator=generator), smooth_depth((1 / inverse)[None])[0]


def align(
    a: Image,
    b: Image,
    T_ba: Tensor = IDENTITY,
    *,
    camera: PinholeCamera = LENS,
    static: tuple[Tensor, Tensor] = (ALL_PIXELS, ALL_PIXELS),
) -> DenseAlignment | None:
    aligner = DenseAligner(DenseOdometryConfig(), camera)
    return aligner.align_views(aligner.view(*a, static[0]), aligner.view(*b, static[1]), T_ba)


def motion_error(alignment: DenseAlignment | None, T_ba: Tensor) -> tuple[float, float]:
    """Error of an alignment, millimetres and degrees."""
    assert alignment is not None
    error = alignment.T_ba @ invert(T_ba)
    return 1e3 * float(error[:3, 3].norm()), float(torch.rad2deg(se3_log(error)[3:].norm()))


A, B = render(IDENTITY), render(MOTION)
