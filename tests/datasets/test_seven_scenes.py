"""7-Scenes: one colour, depth and pose file per frame, 65535 for missing depth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.damaged_folders import assert_ground_truth_is_left_out, assert_rejected
from helpers.tiny_images import as_rgb, colour_of, depth_of, save

from v3d_torch.datasets import load_sequence
from v3d_torch.datasets.image_sequence import ImageSequence
from v3d_torch.datasets.seven_scenes import CAMERA, SevenScenesSequence
from v3d_torch.geometry.camera import PinholeCamera

INFO = """m_versionNumber = 4
m_sensorName = StructureSensor
m_depthShift = 1000
m_calibrationColorIntrinsic = {colour} 0 0 1 0 0 0 0 1
m_calibrationDepthIntrinsic = {depth} 0 0 1 0 0 0 0 1
"""
"""The file of BundleFusion and 12-Scenes, without the first eight numbers of the matrices."""


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


def notes_of(folder: Path) -> list[str]:
    sequence = load_sequence(folder)
    assert isinstance(sequence, ImageSequence)
    return sequence.notes


def test_note_says_that_the_camera_of_another_data_set_is_a_guess(folder: Path) -> None:
    other = folder.rename(folder.with_name("apt0"))
    (note,) = notes_of(other)
    assert note.startswith("the camera is that of 7-Scenes, with a focal length of 585 pixels; for a recording of")
    (other / "K.txt").write_text("585 0 320\n0 585 240\n0 0 1\n")
    assert notes_of(other) == []


@pytest.mark.parametrize("place", ["apt0/info.txt", "apt0/_info.txt", "info.txt"])
def test_camera_is_that_of_the_info_file(folder: Path, place: str) -> None:
    """12-Scenes has it in the parent of the folder with the frames."""
    other = folder.rename(folder.with_name("apt0"))
    camera = "583 0 319 0 0 584 241 0"
    (other.parent / place).write_text(INFO.format(colour=camera, depth=camera))
    sequence = load_sequence(other)
    assert sequence.camera == PinholeCamera(583, 584, 319, 241, depth_scale=1000.0)
    assert notes_of(other) == []
    assert np.array_equal(as_rgb(sequence[1].image), colour_of(1, 640, 480))


def test_colour_of_another_size_is_warped_to_the_depth_camera(folder: Path) -> None:
    for i in range(2):
        ramp = np.broadcast_to(np.arange(1280) / 5, (960, 1280)).astype(np.uint8)
        save(folder / f"frame-{i:06d}.color.png", np.repeat(ramp[..., None], 3, axis=-1))
    (folder / "info.txt").write_text(
        INFO.format(colour="1170 0 639.5 0 0 1170 479.5 0", depth="585 0 319.5 0 0 585 239.5 0")
    )
    image = as_rgb(load_sequence(folder)[0].image)
    assert image.shape == (480, 640, 3)
    assert np.abs(image[:, :, 0] - (2 * np.arange(640) + 0.5) / 5).max() < 1.5


def test_colour_of_another_size_needs_the_info_file(folder: Path) -> None:
    save(folder / "frame-000000.color.png", colour_of(0, 1296, 968))
    assert_rejected(
        folder, r"not supported without an info\.txt that states both cameras \(m_calibrationColorIntrinsic"
    )


@pytest.mark.parametrize(
    ("colour", "depth", "message"),
    [
        ("585 0 320 0 0 585 240 0", "585 0 320 0 0 585", "m_calibrationDepthIntrinsic is not a 4x4 matrix"),
        ("a 0 320 0 0 585 240 0", "585 0 320 0 0 585 240 0", "m_calibrationColorIntrinsic is not a 4x4 matrix"),
        ("585 0 320 0 0 585 240 0", "0 0 320 0 0 585 240 0", "m_calibrationDepthIntrinsic has a focal length below"),
    ],
)
def test_damaged_info_file_is_rejected(folder: Path, colour: str, depth: str, message: str) -> None:
    (folder / "info.txt").write_text(INFO.format(colour=colour, depth=depth))
    assert_rejected(folder, message)


def test_info_file_of_something_else_is_ignored(folder: Path) -> None:
    (folder / "info.txt").write_text("recorded on Monday\n")
    assert load_sequence(folder).camera == CAMERA
