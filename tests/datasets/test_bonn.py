"""Bonn RGB-D Dynamic: published camera, and conversion of the marker poses to camera poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.tiny_images import colour_of, depth_of, save
from scipy.spatial.transform import Rotation

from v3d_torch.datasets import load_sequence
from v3d_torch.datasets.bonn import CAMERA, BonnSequence
from v3d_torch.datasets.tum_writer import TUMWriter
from v3d_torch.geometry.camera import PinholeCamera

POSES = "10 1 2 3 0 0 0 1\n11 1.5 2 3 0 0 0.6 0.8\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "rgbd_bonn_tiny"
    for i in range(2):
        save(root / "rgb" / f"{i}.png", colour_of(i, 640, 480))
        save(root / "depth" / f"{i}.png", depth_of(i, 640, 480))
    (root / "rgb.txt").write_text("# color images\n10.0 rgb/0.png\n11.0 rgb/1.png\n")
    (root / "depth.txt").write_text("# depth maps\n10.01 depth/0.png\n11.01 depth/1.png\n")
    (root / "groundtruth.txt").write_text(POSES)
    return root


def test_bonn_frames_and_camera_match_files(folder: Path) -> None:
    sequence = load_sequence(str(folder))
    assert isinstance(sequence, BonnSequence)
    assert (sequence.name, len(sequence)) == ("rgbd_bonn_tiny", 2)
    camera = sequence.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (542.822841, 542.576870, 315.593520, 237.756098)
    assert camera.distortion == (0.039903, -0.099343, -0.000730, -0.000144, 0.0)
    frame = sequence[1]
    assert frame.stamp == 11.0
    np.testing.assert_allclose(frame.depth[0], depth_of(1, 640, 480) / 5000, rtol=1e-6)
    assert load_sequence(str(folder), camera="tum_fr3").camera.fx == 535.4


def test_convention_ground_truth_is_of_the_camera(folder: Path) -> None:
    """Published formula T_ROS^-1 T T_ROS T_m, with only the rotation and translation of T_m."""
    T_ros = np.array([[-1, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
    scaled = np.array([[1.0157, 0.1828, -0.2389], [0.0009, -0.8431, -0.6413], [-0.3009, 0.6147, -0.8085]])
    T_m = np.eye(4)
    T_m[:3, :3] = Rotation.from_matrix(scaled / np.cbrt(np.linalg.det(scaled))).as_matrix()
    T_m[:3, 3] = [0.0113, -0.0098, 0.0111]
    groundtruth = load_sequence(str(folder)).groundtruth
    assert groundtruth is not None and groundtruth.stamps.tolist() == [10.0, 11.0]
    for T_wc, position, angle in zip(
        groundtruth.T_wc.numpy(), ([1, 2, 3], [1.5, 2, 3]), (0, 2 * np.arcsin(0.6)), strict=True
    ):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.from_euler("z", angle).as_matrix(), position
        np.testing.assert_allclose(T_wc, np.linalg.inv(T_ros) @ T @ T_ros @ T_m, atol=1e-4)
        np.testing.assert_allclose(T_wc[:3, :3] @ T_wc[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(T_wc[:3, :3]) > 0
        assert np.linalg.norm(T_wc[:3, 3] - (np.linalg.inv(T_ros) @ T)[:3, 3]) == pytest.approx(0.0186, abs=2e-4)


def test_bonn_folder_with_camera_file_has_its_camera_and_converted_poses(folder: Path) -> None:
    converted = load_sequence(str(folder)).groundtruth
    (folder / "camera.yaml").write_text("fx: 1\nfy: 2\ncx: 3\ncy: 4\nwidth: 640\nheight: 480\ndepth_scale: 1000\n")
    sequence = load_sequence(str(folder))
    assert isinstance(sequence, BonnSequence)
    assert sequence.camera == PinholeCamera(1, 2, 3, 4, depth_scale=1000)
    assert sequence.groundtruth is not None and converted is not None
    assert torch.equal(sequence.groundtruth.T_wc, converted.T_wc)


def test_recorded_bonn_sequence_is_not_converted_again(folder: Path, tmp_path: Path) -> None:
    original = load_sequence(str(folder))
    copy = tmp_path / "copies" / folder.name
    with TUMWriter(copy, original.camera, original.groundtruth) as writer:
        for frame in original:
            writer.add(frame)
    recorded = load_sequence(str(copy))
    assert not isinstance(recorded, BonnSequence) and recorded.camera == original.camera
    assert recorded.groundtruth is not None and original.groundtruth is not None
    torch.testing.assert_close(recorded.groundtruth.T_wc, original.groundtruth.T_wc, rtol=0, atol=1e-8)


def test_bonn_sequence_without_ground_truth_is_opened(folder: Path) -> None:
    (folder / "groundtruth.txt").unlink()
    sequence = load_sequence(str(folder))
    assert sequence.groundtruth is None and sequence.camera is CAMERA
    assert sequence[0].depth.dtype == torch.float32
