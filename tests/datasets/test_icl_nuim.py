"""ICL-NUIM: timestamps from frame numbers, and conversion of camera and poses to a y axis that points down."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.tiny_images import as_rgb, colour_of, depth_of, save

from v3d_torch.datasets import RGBDSequence, load_sequence
from v3d_torch.datasets.icl_nuim import ICLNUIMSequence
from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, se3_exp

POSES = "2 1 2 3 0.1 0.2 -0.3 0.9\n3 -1 0.5 2 0 0.5 0.1 0.8\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "living_room_traj0_frei_png"
    for i in range(1, 4):
        save(root / "rgb" / f"{i}.png", colour_of(i, 640, 480))
        save(root / "depth" / f"{i}.png", depth_of(i, 640, 480))
    (root / "associations.txt").write_text("".join(f"{i} depth/{i}.png {i} rgb/{i}.png\n" for i in range(1, 4)))
    (root / "livingRoom0.gt.freiburg").write_text(POSES)
    return root


def test_icl_nuim_frames_match_files(folder: Path) -> None:
    sequence = load_sequence(str(folder))
    assert isinstance(sequence, ICLNUIMSequence)
    assert sequence.name == folder.name
    assert sequence.stamps.tolist() == [1 / 30, 2 / 30, 3 / 30]
    assert np.array_equal(as_rgb(sequence[1].image), colour_of(2, 640, 480))
    np.testing.assert_allclose(sequence[1].depth[0], depth_of(2, 640, 480) / 5000, rtol=1e-6)
    assert sequence.groundtruth is not None
    assert sequence.groundtruth.stamps.tolist() == [2 / 30, 3 / 30]


def test_convention_y_points_down(folder: Path) -> None:
    """A point has the same pixel as with the published camera (fy = -480) and the published pose."""
    sequence = load_sequence(str(folder))
    assert sequence.groundtruth is not None
    camera = sequence.camera
    published = read_trajectory(folder / "livingRoom0.gt.freiburg").T_wc
    K = torch.tensor([[481.2, 0, 319.5], [0, -480.0, 239.5], [0, 0, 1]], dtype=torch.float64)
    in_front = torch.tensor([[0.3, -0.2, 2.0, 1.0], [-0.5, 0.4, 3.0, 1.0]], dtype=torch.float64)
    for T_wc, T_wc_published in zip(sequence.groundtruth.T_wc, published, strict=True):
        world = in_front @ T_wc_published.T
        expected = in_front[:, :3] @ K.T
        flipped = world * torch.tensor([1, -1, 1, 1])
        pixels = camera.project((flipped @ invert(T_wc).T)[:, :3])
        torch.testing.assert_close(pixels, expected[:, :2] / expected[:, 2:])
        assert torch.det(T_wc[:3, :3]) == pytest.approx(1.0)


def test_upward_motion_of_icl_nuim_is_negative_y(folder: Path) -> None:
    up = se3_exp(torch.tensor([0.0, 0.5, 0, 0, 0, 0], dtype=torch.float64))
    (folder / "livingRoom0.gt.freiburg").write_text(f"1 0 {up[1, 3].item()} 0 0 0 0 1\n")
    groundtruth = load_sequence(str(folder)).groundtruth
    assert groundtruth is not None and groundtruth.T_wc[0, 1, 3] == -0.5


def test_two_ground_truth_files_are_rejected(folder: Path) -> None:
    (folder / "livingRoom0n.gt.freiburg").write_text(POSES)
    with pytest.raises(
        InputError, match=r"several ground-truth files \(livingRoom0.gt.freiburg, livingRoom0n.gt.freiburg\)"
    ):
        load_sequence(str(folder))


# --- original files


@pytest.fixture
def original(tmp_path: Path) -> Path:
    """Files of POV-Ray: frames 1 and 2 show a floor 1.2 m below the camera, and a wall 3 m ahead."""
    root = tmp_path / "living_room_traj0_loop"
    u, v = np.meshgrid(np.arange(640), np.arange(480))
    rays = np.stack([(u - 319.5) / 481.2, (v - 239.5) / -480.0, np.ones(u.shape)], axis=-1)  # published: y points up
    depth = np.where(rays[..., 1] < -0.4, -1.2 / np.minimum(rays[..., 1], -1e-6), 3.0)
    distances = " ".join(f"{value:.6g}" for value in (depth * np.linalg.norm(rays, axis=-1)).ravel().tolist())
    for i in (1, 2):
        save(root / f"scene_00_{i:04d}.png", colour_of(i, 640, 480))
        (root / f"scene_00_{i:04d}.depth").write_text(distances)
        (root / f"scene_00_{i:04d}.txt").write_text("cam_pos = [1.3705, 1.51739, 1.44963]';\n")
    (root / "livingRoom0.gt.freiburg").write_text("1 0 0 -2.25 0 0 0 1\n2 0 0.009 -2.249 -0.001 0 0 0.999999\n")
    return root


def test_distance_along_the_ray_becomes_depth(original: Path) -> None:
    sequence = load_sequence(str(original))
    assert isinstance(sequence, ICLNUIMSequence) and isinstance(sequence, RGBDSequence)
    assert (sequence.name, sequence.stamps.tolist()) == (original.name, [1 / 30, 2 / 30])
    frame = sequence[0]
    assert np.array_equal(as_rgb(frame.image), colour_of(1, 640, 480))
    points = frame.depth[0, :, :, None] * sequence.camera.rays
    wall = frame.depth[0, :400]
    torch.testing.assert_close(wall, torch.full_like(wall, 3.0), rtol=0, atol=1e-4)
    assert (points[440:, :, 1] - 1.2).abs().max() < 1e-4  # the floor is below the camera: y points down


def test_ground_truth_of_the_original_files_is_mirrored(original: Path) -> None:
    groundtruth = load_sequence(str(original)).groundtruth
    assert groundtruth is not None and groundtruth.stamps.tolist() == [1 / 30, 2 / 30]
    assert groundtruth.T_wc[1, :3, 3].tolist() == [0, -0.009, -2.249]
    assert groundtruth.T_wc[1, 2, 1] > 0  # a rotation about x changes its sign, too


def test_original_files_without_ground_truth_are_read(original: Path) -> None:
    (original / "livingRoom0.gt.freiburg").unlink()
    sequence = load_sequence(str(original))
    assert sequence.groundtruth is None and len(sequence) == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3", "has 3 numbers, expected 640x480, one for each pixel; copy it again"),
        ("1 2 x", "contains a value that is not a number .*; copy it again"),
        ("", "has 0 numbers"),
    ],
)
def test_damaged_depth_of_the_original_files_is_rejected(original: Path, text: str, message: str) -> None:
    (original / "scene_00_0001.depth").write_text(text)
    with pytest.raises(InputError, match=f"scene_00_0001.depth: {message}"):
        load_sequence(str(original))


def test_published_camera_with_negative_fy_is_explained(original: Path) -> None:
    (original / "K.txt").write_text("481.2 0 319.5\n0 -480 239.5\n0 0 1\n")
    with pytest.raises(InputError, match=r"K.txt: fy is -480.0; a negative fy, as published with ICL-NUIM, means"):
        load_sequence(str(original))
    (original / "K.txt").write_text("481.2 0 319.5\n0 480 239.5\n0 0 1\n")
    assert load_sequence(str(original)).camera == PinholeCamera(481.2, 480, 319.5, 239.5, depth_scale=5000)
