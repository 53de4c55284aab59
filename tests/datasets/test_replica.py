"""Replica: frames in one folder, poses in one file, and the camera of all sequences in the folder above."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.damaged_folders import assert_ground_truth_is_left_out
from helpers.tiny_images import HEIGHT, WIDTH, as_rgb, colour_of, depth_of, save

from v3d_torch.datasets import load_sequence
from v3d_torch.datasets.replica import CAMERA, ReplicaSequence
from v3d_torch.errors import InputError

STATED = {"w": WIDTH, "h": HEIGHT, "fx": 30.0, "fy": 31.0, "cx": 15.5, "cy": 11.5, "scale": 6553.5}


def pose_line(frame: int) -> str:
    """Pose of a camera that looks along the x axis of the world, in row-major order."""
    return f"0 0 1 {frame} -1 0 0 2 0 -1 0 3 0 0 0 1\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "Replica" / "room0"
    for i in range(2):
        save(root / "results" / f"frame{i:06d}.png", colour_of(i))
        save(root / "results" / f"depth{i:06d}.png", depth_of(i))
    (root / "traj.txt").write_text(pose_line(0) + pose_line(1))
    (root.parent / "cam_params.json").write_text(json.dumps({"camera": STATED}))
    return root


def test_replica_frames_match_files(folder: Path) -> None:
    sequence = load_sequence(folder)
    assert isinstance(sequence, ReplicaSequence) and sequence.name == "room0"
    assert sequence.stamps.tolist() == [0, 1 / 30]
    camera = sequence.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (30.0, 31.0, 15.5, 11.5)
    assert (camera.width, camera.height, camera.depth_scale, camera.readout) == (WIDTH, HEIGHT, 6553.5, 0.0)
    assert np.array_equal(as_rgb(sequence[1].image), colour_of(1))
    np.testing.assert_allclose(sequence[1].depth[0], depth_of(1) / 6553.5, rtol=1e-6)


def test_convention_poses_are_camera_to_world_in_row_major_order(folder: Path) -> None:
    groundtruth = load_sequence(folder).groundtruth
    assert groundtruth is not None and groundtruth.stamps.tolist() == [0, 1 / 30]
    assert groundtruth.T_wc[:, :3, 3].tolist() == [[0, 2, 3], [1, 2, 3]]
    assert groundtruth.T_wc[1, :3, 2].tolist() == [1, 0, 0]  # the optical axis in the world


def test_pose_of_a_missing_frame_belongs_to_its_number(folder: Path) -> None:
    for kind in ("frame", "depth"):
        (folder / "results" / f"{kind}000000.png").unlink()
    sequence = load_sequence(folder)
    assert sequence.stamps.tolist() == [1 / 30]
    assert sequence.groundtruth is not None
    assert sequence.groundtruth.poses_at(sequence.stamps)[:, :3, 3].tolist() == [[1, 2, 3]]


def test_without_a_camera_file_the_published_camera_is_used(folder: Path) -> None:
    (folder.parent / "cam_params.json").unlink()
    for i in range(2):
        save(folder / "results" / f"frame{i:06d}.png", colour_of(i, 1200, 680))
        save(folder / "results" / f"depth{i:06d}.png", depth_of(i, 1200, 680))
    sequence = load_sequence(folder)
    assert sequence.camera == CAMERA
    assert sequence[0].image.shape == (3, 680, 1200)


def test_camera_file_in_the_folder_takes_precedence(folder: Path) -> None:
    (folder / "cam_params.json").write_text(json.dumps({"camera": STATED | {"fx": 29.0}}))
    assert load_sequence(folder).camera.fx == 29.0


@pytest.mark.parametrize("content", ["{", "[]", '{"camera": {"w": 32}}', '{"camera": 1}'])
def test_damaged_camera_file_is_rejected(folder: Path, content: str) -> None:
    (folder.parent / "cam_params.json").write_text(content)
    with pytest.raises(InputError, match=r"cam_params.json: has no camera with fx, fy, cx, cy, w, h, scale; copy it"):
        load_sequence(folder)


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("1 0 0 0\n", "line 2 is not a 4x4 matrix of 16 numbers"),
        (pose_line(1).replace("3", "three"), "line 2 is not a 4x4 matrix of 16 numbers"),
        (16 * "2 " + "\n", "line 2: is not a valid rigid transform"),
    ],
)
def test_damaged_poses_give_no_ground_truth(folder: Path, line: str, problem: str) -> None:
    (folder / "traj.txt").write_text(pose_line(0) + line)
    assert_ground_truth_is_left_out(folder, folder / "traj.txt", problem)


def test_lost_poses_are_left_out(folder: Path) -> None:
    (folder / "traj.txt").write_text(pose_line(0) + 16 * "nan " + "\n")
    groundtruth = load_sequence(folder).groundtruth
    assert groundtruth is not None and groundtruth.stamps.tolist() == [0]
