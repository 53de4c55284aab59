"""7-Scenes: one colour, depth and pose file per frame, 65535 for missing depth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.damaged_folders import assert_ground_truth_is_left_out
from helpers.tiny_images import as_rgb, colour_of, depth_of, save

from v3d_torch.datasets import load_sequence
from v3d_torch.datasets.seven_scenes import CAMERA, SevenScenesSequence


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "chess" / "seq-01"
    for i in range(2):
        units = depth_of(i, 640, 480)
        save(root / f"frame-{i:06d}.color.png", colour_of(i, 640, 480))
        save(root / f"frame-{i:06d}.depth.png", np.where(units == 0, 65535, units).astype(np.uint16))
        (root / f"frame-{i:06d}.pose.txt").write_text(f"1 0 0 {i}\t\n0 1 0 2\n0 0 1 3\n0 0 0 1\n")
    return root


def test_seven_scenes_frames_match_files(folder: Path) -> None:
    sequence = load_sequence(str(folder))
    assert isinstance(sequence, SevenScenesSequence)
    assert (sequence.name, sequence.camera) == ("chess/seq-01", CAMERA)
    assert sequence.stamps.tolist() == [0, 1 / 30]
    assert np.array_equal(as_rgb(sequence[1].image), colour_of(1, 640, 480))
    np.testing.assert_allclose(sequence[1].depth[0], depth_of(1, 640, 480) / 1000, rtol=1e-6)
    assert (sequence[1].depth == 0).any()
    assert sequence.groundtruth is not None
    assert sequence.groundtruth.stamps.tolist() == [0, 1 / 30]
    assert sequence.groundtruth.T_wc[:, :3, 3].tolist() == [[0, 2, 3], [1, 2, 3]]


def test_colour_images_without_depth_are_left_out_with_a_note(folder: Path) -> None:
    sequence = load_sequence(folder)
    assert isinstance(sequence, SevenScenesSequence) and sequence.notes == []
    (folder / "frame-000001.depth.png").unlink()
    sequence = load_sequence(folder)
    assert isinstance(sequence, SevenScenesSequence) and sequence.notes == [
        "1 of 2 colour images have no depth image of the same frame number and are left out (the last is"
        " frame-000001.color.png)"
    ]


def test_missing_and_damaged_poses_give_no_ground_truth(folder: Path) -> None:
    file = folder / "frame-000000.pose.txt"
    file.write_text("no pose")
    assert_ground_truth_is_left_out(folder, file, "is not a 3x3 or 4x4 matrix")
    for path in folder.glob("*.pose.txt"):
        path.unlink()
    assert load_sequence(str(folder)).groundtruth is None
