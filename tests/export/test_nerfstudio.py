"""Folders for nerfstudio, read by its documented keys and conventions."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from helpers.posed_images import CAMERA, COLOURS, DISTORTED, FISHEYE, POINTS, RATIONAL, T_WC, posed_images

from v3d_torch.errors import ConfigError, OutputError
from v3d_torch.export.nerfstudio import opengl_pose, write_nerfstudio
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.io.ply import write_ply


def export(folder: Path, camera: PinholeCamera = CAMERA) -> dict[str, Any]:
    """Write a folder and return its transforms.json."""
    points = folder / "map.ply"
    write_ply(points, POINTS, torch.from_numpy(COLOURS))
    write_nerfstudio(folder / "out", camera, posed_images(camera), points)
    assert (folder / "out" / "points.ply").read_bytes() == points.read_bytes()
    transforms = json.loads((folder / "out" / "transforms.json").read_text())
    assert len(transforms["frames"]) == len(T_WC)
    return transforms


def project(transforms: dict[str, Any], frame: dict[str, Any], points: np.ndarray) -> np.ndarray:
    """Project world points as nerfstudio does: OpenGL camera, origin of the pixels at the corner of the image."""
    K = np.array([[transforms["fl_x"], 0, transforms["cx"]], [0, transforms["fl_y"], transforms["cy"]], [0, 0, 1]])
    K[:2, 2] -= 0.5  # OpenCV has the centre of the first pixel at 0
    T_gl = np.linalg.inv(np.array(frame["transform_matrix"]))
    in_opencv = (points @ T_gl[:3, :3].T + T_gl[:3, 3]) * [1, -1, -1]
    if transforms["camera_model"] == "OPENCV_FISHEYE":
        distortion = np.array([transforms[name] for name in ("k1", "k2", "k3", "k4")])
        return cv2.fisheye.projectPoints(in_opencv[:, None], np.zeros(3), np.zeros(3), K, distortion)[0][:, 0]
    distortion = np.array([transforms[name] for name in ("k1", "k2", "p1", "p2", "k3")])
    return cv2.projectPoints(in_opencv, np.zeros(3), np.zeros(3), K, distortion)[0][:, 0]


def test_convention_camera_looks_along_minus_z_with_y_up() -> None:
    T_w_gl = opengl_pose(torch.eye(4, dtype=torch.float64))
    assert (T_w_gl @ torch.tensor([0.0, 0, -1, 0], dtype=torch.float64)).tolist() == [0, 0, 1, 0]  # forward
    assert (T_w_gl @ torch.tensor([0.0, 1, 0, 0], dtype=torch.float64)).tolist() == [0, -1, 0, 0]  # up
    assert (T_w_gl @ torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)).tolist() == [1, 0, 0, 0]  # right
    for T_wc in T_WC:
        assert torch.equal(opengl_pose(T_wc)[:, 3], T_wc[:, 3])


@pytest.mark.parametrize("camera", [CAMERA, DISTORTED, FISHEYE])
def test_convention_points_of_the_map_project_to_their_pixels(camera: PinholeCamera, tmp_path: Path) -> None:
    transforms = export(tmp_path, camera)
    for frame in transforms["frames"]:
        image = cv2.imread(str(tmp_path / "out" / frame["file_path"]))[..., ::-1]
        for (u, v), colour in zip(project(transforms, frame, POINTS.numpy()).round().astype(int), COLOURS, strict=True):
            np.testing.assert_array_equal(image[v - 2 : v + 3, u - 2 : u + 3], np.broadcast_to(colour, (5, 5, 3)))


def test_principal_point_counts_from_the_corner_of_the_image(tmp_path: Path) -> None:
    transforms = export(tmp_path)
    assert (transforms["cx"], transforms["cy"]) == (CAMERA.cx + 0.5, CAMERA.cy + 0.5)
    assert (transforms["w"], transforms["h"], transforms["camera_model"]) == (160, 120, "OPENCV")


def test_depth_is_in_the_stated_unit_and_zero_where_something_moves(tmp_path: Path) -> None:
    transforms = export(tmp_path)
    assert transforms["depth_unit_scale_factor"] == 0.001  # nerfstudio's default
    for frame, image in zip(transforms["frames"], posed_images(), strict=True):
        units = cv2.imread(str(tmp_path / "out" / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED)
        assert units.dtype == np.uint16
        np.testing.assert_allclose(units * 0.001, image.static_depth[0], atol=0.0005)


def test_depth_beyond_sixteen_bits_is_no_measurement_and_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    image = posed_images()[0]
    depth = image.frame.depth.clone()
    depth[0, 5, 50:52], depth[0, 6, 50], depth[0, 7, 0] = 70.0, 65.534, 70.0  # the last one is masked
    write_ply(tmp_path / "map.ply", POINTS, torch.from_numpy(COLOURS))
    far = replace(image, frame=replace(image.frame, depth=depth))
    write_nerfstudio(tmp_path / "out", CAMERA, [far], tmp_path / "map.ply")
    units = cv2.imread(str(tmp_path / "out" / "depths" / image.name), cv2.IMREAD_UNCHANGED)
    assert units[5, 50:53].tolist() == [0, 0, 3000] and units[6, 50] == 65534
    assert "2 depth values beyond 65.53 m were saved as 0" in caplog.text


def test_every_frame_has_a_mask_that_is_black_where_something_moves(tmp_path: Path) -> None:
    for frame in export(tmp_path)["frames"]:
        mask = cv2.imread(str(tmp_path / "out" / frame["mask_path"]), cv2.IMREAD_UNCHANGED)
        assert (mask[:, :40] == 0).all() and (mask[:, 40:] == 255).all()


def test_names_sort_in_the_order_of_the_frames(tmp_path: Path) -> None:
    names = [frame["file_path"] for frame in export(tmp_path)["frames"]]
    assert names == ["images/frame_000000.png", "images/frame_000010.png"] == sorted(names)


def test_distortion_model_that_nerfstudio_lacks_is_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nerfstudio has no distortion model rational_polynomial; .*--undistort"):
        write_nerfstudio(tmp_path / "out", RATIONAL, posed_images(RATIONAL), tmp_path / "map.ply")
    assert not (tmp_path / "out").exists()


def test_folder_that_cannot_be_written_is_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    write_ply(tmp_path / "map.ply", POINTS, torch.from_numpy(COLOURS))
    with pytest.raises(OutputError, match=r"file.*: cannot be (made|written) "):
        write_nerfstudio(tmp_path / "file", CAMERA, posed_images(), tmp_path / "map.ply")
