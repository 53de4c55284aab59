"""Images with poses and masks, and their undistortion."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from helpers.posed_images import CAMERA, COLOURS, DISTORTED, FISHEYE, POINTS, RATIONAL, T_WC, posed_images

from v3d_torch.export.posed_image import Undistorter
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert


def test_static_depth_is_zero_where_something_moves() -> None:
    (image, *_) = posed_images()
    assert (image.static_depth[0, :, :40] == 0).all()
    assert torch.equal(image.static_depth[0, :, 40:], image.frame.depth[0, :, 40:])


def test_convention_written_mask_is_white_where_the_scene_is_static(tmp_path: Path) -> None:
    (image, *_) = posed_images()
    image.write_mask(tmp_path / "mask.png")
    mask = cv2.imread(str(tmp_path / "mask.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(mask, np.where(image.static.numpy(), 255, 0))


def test_colour_image_is_written_without_loss(tmp_path: Path) -> None:
    _, image = posed_images()
    image.write_colour(tmp_path)
    written = cv2.imread(str(tmp_path / "frame_000010.png"))[..., ::-1]
    np.testing.assert_array_equal(written, image.frame.image.permute(1, 2, 0))


@pytest.mark.parametrize("camera", [DISTORTED, FISHEYE, RATIONAL])
def test_convention_undistorted_image_shows_points_where_the_pinhole_camera_projects_them(
    camera: PinholeCamera,
) -> None:
    undistort = Undistorter(camera)
    assert not undistort.camera.is_distorted and torch.equal(undistort.camera.K, camera.K)
    for image in map(undistort, posed_images(camera)):
        T_cw = invert(image.T_wc)
        points = POINTS @ T_cw[:3, :3].T + T_cw[:3, 3]
        for (u, v), z, colour in zip(
            undistort.camera.project(points).round().long(), points[:, 2], COLOURS, strict=True
        ):
            assert image.frame.image[:, v, u].tolist() == colour.tolist()
            assert image.frame.depth[0, v, u] == z.float()


def test_undistorted_mask_is_moved_with_the_image_and_excludes_what_was_not_recorded() -> None:
    undistort = Undistorter(DISTORTED)
    image = undistort(posed_images(DISTORTED)[0])
    v, u = torch.meshgrid(torch.arange(120), torch.arange(160), indexing="ij")
    source = DISTORTED.distort(torch.stack([u, v], dim=-1).reshape(-1, 2)).reshape(120, 160, 2)
    clear = ((source[..., 0] - 39.5).abs() > 1) & (source[..., 0] < 158) & (source[..., 1] > 1) & (source[..., 1] < 118)
    clear &= source[..., 0] > 1
    assert clear.float().mean() > 0.8
    assert torch.equal(image.static[clear], (source[..., 0] > 39.5)[clear])
    outside = (source < -1).any(dim=-1) | (source[..., 0] > 160) | (source[..., 1] > 120)
    assert not image.static[outside].any() and not image.frame.depth[0][outside].any()


def test_undistorted_depth_has_only_measured_values() -> None:
    """Between a surface and the one behind it there is none."""
    image = posed_images(DISTORTED)[0]
    measured, undistorted = (each.frame.depth.unique().tolist() for each in (image, Undistorter(DISTORTED)(image)))
    assert set(undistorted) <= {0.0, *measured}


def test_undistortion_of_pinhole_image_changes_nothing() -> None:
    for image in posed_images():
        same = Undistorter(CAMERA)(image)
        assert torch.equal(same.frame.image, image.frame.image)
        assert torch.equal(same.frame.depth, image.frame.depth) and torch.equal(same.static, image.static)
        assert torch.equal(same.T_wc, image.T_wc) and len(T_WC) == 2
