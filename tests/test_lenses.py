"""The whole system with the images of a fisheye lens and of a rational lens model."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest
import torch
from helpers.rendered_planes import Paint, align, motion_error, render, smooth_pattern
from torch import Tensor

from v3d_torch import V3DSLAM, PinholeCamera, RGBDFrame
from v3d_torch.config.loading import load_config
from v3d_torch.errors import InputError
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.types import TrackingStatus

FISHEYE = PinholeCamera(
    130, 131, 158.7, 120.2, 320, 240, (-0.01, 0.02, -0.01, 0.002), readout=0, distortion_model="equidistant"
)
RATIONAL = PinholeCamera(
    160, 161, 158.7, 120.2, 320, 240, (0.4548, -2.5286, 0.0006, -0.0003, 1.4623, 0.3332, -2.3455, 1.3887), readout=0
)
ROOM = tuple((*axis, distance) for axis, distance in zip(torch.eye(3).tolist(), (1.7, 1.3, 2.4), strict=True))
"""Walls to the right, below and ahead; `closed` adds those on the other sides."""
STEP = se3_exp(torch.tensor([0.02, -0.01, 0.015, 0.01, -0.03, 0.02], dtype=torch.float64))
"""Motion of the scene in the camera frame between two frames."""


def closed(planes: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...], ...]:
    """Add the opposite walls."""
    return (*planes, *((-a, -b, -c, d) for a, b, c, d in planes))


def bricks(points: Tensor, plane: int) -> Tensor:
    """Random brightness of cells with sides of 5 cm."""
    cell = (points / 0.05 + 0.37).floor()
    noise = torch.sin(cell @ torch.tensor([12.9898, 78.233, 37.719], dtype=torch.float64) + plane) * 43758.5453
    return noise - noise.floor()


@cache
def view(camera: PinholeCamera, index: int, paint: Paint = bricks) -> tuple[Tensor, Tensor, Tensor]:
    """Brightness, depth, and pose ``T_cw`` of a frame."""
    T_cw = torch.linalg.matrix_power(STEP, index)
    grey, depth = render(T_cw, camera, closed(ROOM), paint)
    return grey, depth, T_cw


def track(camera: PinholeCamera, lens: PinholeCamera) -> tuple[float, list[TrackingStatus]]:
    """Track images of a lens with a camera model; return the largest position error, metres, and the statuses."""
    slam = V3DSLAM(camera, config=load_config(None, ("segmentation.source=none",)))
    errors = []
    for index in range(6):
        grey, depth, T_cw = view(lens, index)
        image = (255 * grey).to(torch.uint8).repeat(3, 1, 1)
        T_wc = slam(RGBDFrame(index, index / 30, image, depth)).T_wc
        errors.append(float((T_wc[:3, 3] - invert(T_cw)[:3, 3]).norm()))
    return max(errors), slam.poses.statuses


@pytest.mark.parametrize("lens", [FISHEYE, RATIONAL], ids=["equidistant", "rational_polynomial"])
def test_images_of_a_lens_are_tracked_accurately(lens: PinholeCamera) -> None:
    error, statuses = track(lens, lens)
    assert set(statuses) == {TrackingStatus.TRACKED}
    assert error < 0.01  # without antialiasing


def test_images_of_a_fisheye_do_not_fit_a_pinhole() -> None:
    pinhole = replace(FISHEYE, distortion=(), distortion_model="plumb_bob")
    assert track(pinhole, FISHEYE)[0] > 2 * track(FISHEYE, FISHEYE)[0]


@pytest.mark.parametrize("lens", [FISHEYE, RATIONAL], ids=["equidistant", "rational_polynomial"])
def test_dense_alignment_of_images_of_a_lens_is_accurate(lens: PinholeCamera) -> None:
    (grey_a, depth_a, T_aw), (grey_b, depth_b, T_bw) = (view(lens, index, smooth_pattern) for index in range(2))
    everything = torch.ones(240, 320, dtype=torch.bool)
    aligned = align((grey_a, depth_a), (grey_b, depth_b), camera=lens, static=(everything, everything))
    millimetres, degrees = motion_error(aligned, T_bw @ invert(T_aw))
    assert millimetres < 1 and degrees < 0.05


@pytest.mark.parametrize("lens", [FISHEYE, RATIONAL], ids=["equidistant", "rational_polynomial"])
def test_back_projected_images_of_a_lens_lie_on_the_walls(lens: PinholeCamera) -> None:
    _, depth, _ = view(lens, 0)
    points = (depth[0, :, :, None] * lens.rays).abs()
    distance = (points - torch.tensor([1.7, 1.3, 2.4])).abs().amin(dim=-1)
    assert distance.max() < 1e-4


@pytest.mark.parametrize(
    "camera",
    [
        PinholeCamera(130, 130, 320, 240, distortion=(0, 0, 0, 0), distortion_model="equidistant"),
        PinholeCamera(285, 286, 424, 400, 848, 800, (-0.0085, 0.046, -0.043, 0.0083), distortion_model="equidistant"),
        PinholeCamera(500, 500, 320, 240, distortion=(-0.131, -0.585, 0.003, -0.001, 0.164)),
    ],
    ids=["more than 180 degrees", "corners beside the image circle", "polynomial that folds back"],
)
def test_camera_with_pixels_without_a_ray_is_rejected(camera: PinholeCamera) -> None:
    with pytest.raises(InputError, match=r"lens model of the camera gives some of the .* pixels no ray .*; crop"):
        V3DSLAM(camera, config=load_config(None, ("segmentation.source=none",)))
