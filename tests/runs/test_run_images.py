"""Images of a finished run: frames with a known pose, and checks that source and masks are those of the run."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import cv2
import numpy as np
import pyarrow as pa
import pytest
import torch
from helpers.short_wall import FRAMES, StoredWall, Wall

from v3d_torch.datasets import RGBDStream
from v3d_torch.errors import InputError
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.runs.run_images import LocalisedFrames, localised_frames, posed_images
from v3d_torch.runs.stored_run import StoredRun
from v3d_torch.types import RGBDFrame, TrackingStatus, Trajectory

TRACKED, ODOMETRY = TrackingStatus.TRACKED, TrackingStatus.ODOMETRY
DISCONNECTED, LOST = TrackingStatus.DISCONNECTED, TrackingStatus.LOST


class LiveWall:
    """The wall as a stream that can be read only once, in order."""

    name, camera, groundtruth = "stream", Wall.camera, None

    def __iter__(self) -> Iterator[RGBDFrame]:
        return map(Wall().__getitem__, range(FRAMES))


def make_run(folder: Path, *statuses: TrackingStatus) -> StoredRun:
    """Run whose source has a broken frame, 2, and whose keyframes are every second frame."""
    count = len(statuses)
    index = [0, 1, *range(3, count + 1)][:count]
    twists = torch.arange(count).double()[:, None] * torch.tensor([0.1, 0, 0, 0, 0.1, 0], dtype=torch.float64)
    run = SimpleNamespace(
        folder=folder,
        frames=pa.table({"frame": index, "keyframe": [position % 2 == 0 for position in range(count)]}),
        metrics=SimpleNamespace(status=list(statuses)),
        trajectory=Trajectory(torch.tensor(index, dtype=torch.float64) / 10, se3_exp(twists)),
    )
    return cast("StoredRun", run)


def test_frames_with_a_known_pose_have_their_positions_in_the_source_and_their_poses(tmp_path: Path) -> None:
    run = make_run(tmp_path, TRACKED, LOST, DISCONNECTED, ODOMETRY, TRACKED, TRACKED)
    assert run.trajectory is not None
    for only_keyframes, rows, indices in ((False, [0, 3, 4, 5], [0, 4, 5, 6]), (True, [0, 4], [0, 5])):
        frames = localised_frames(run, only_keyframes=only_keyframes)
        assert frames.indices == indices and len(frames) == len(rows)
        assert torch.equal(frames.poses.stamps, run.trajectory.stamps[rows])
        assert torch.equal(frames.poses.T_wc, run.trajectory.T_wc[rows])


def test_every_second_frame_keeps_its_pose(tmp_path: Path) -> None:
    frames = localised_frames(make_run(tmp_path, *[TRACKED] * 6))
    second = frames.every(2)
    assert second.indices == [0, 3, 5]
    assert torch.equal(second.poses.stamps, frames.poses.stamps[[0, 2, 4]])
    assert torch.equal(second.poses.T_wc, frames.poses.T_wc[[0, 2, 4]])


def test_run_that_never_found_the_camera_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has no frame with a known pose; run another sequence"):
        localised_frames(make_run(tmp_path, LOST, LOST, DISCONNECTED))


def frames_at(*stamps: float) -> LocalisedFrames:
    """Frames of the wall with the given timestamps, from the first one on."""
    poses = Trajectory(torch.tensor(stamps, dtype=torch.float64), se3_exp(torch.zeros(len(stamps), 6).double()))
    return LocalisedFrames(list(range(len(stamps))), poses)


@pytest.mark.parametrize("source", [StoredWall(), LiveWall()], ids=["sequence", "stream"])
def test_all_frames_are_read_from_a_sequence_and_from_a_stream(source: RGBDStream, tmp_path: Path) -> None:
    run = make_run(tmp_path, *[TRACKED] * (FRAMES - 1))
    images = list(posed_images(run, source, localised_frames(run), masks=False))
    assert [image.frame.index for image in images] == [0, 1, *range(3, FRAMES)]
    assert all(bool(image.static.all()) for image in images)


def test_rounded_timestamps_agree_and_those_of_another_recording_do_not(tmp_path: Path) -> None:
    run, wall = make_run(tmp_path, TRACKED), StoredWall()
    assert len(list(posed_images(run, wall, frames_at(0.0, 0.100001), masks=False))) == 2
    with pytest.raises(InputError, match=r"frame 1 is at 0\.100000 s, but at 0\.101000 s in .*with --seq"):
        list(posed_images(run, wall, frames_at(0.0, 0.101), masks=False))


def test_source_with_one_frame_less_than_the_run_is_rejected(tmp_path: Path) -> None:
    frames = frames_at(*(index / 10 for index in range(FRAMES + 1)))
    with pytest.raises(InputError, match=f"wall: has {FRAMES} frames, fewer than the run"):
        posed_images(make_run(tmp_path, TRACKED), StoredWall(), frames, masks=False)


def test_masks_are_static_where_they_are_black_and_have_the_size_of_the_images(tmp_path: Path) -> None:
    (tmp_path / "map_masks").mkdir()
    mask = np.zeros((240, 320), np.uint8)
    mask[50:60] = 255
    for name, image in (("0.000000", mask), ("0.100000", mask[:120])):
        assert cv2.imwrite(str(tmp_path / "map_masks" / f"{name}.png"), image)
    images = posed_images(make_run(tmp_path, TRACKED), StoredWall(), frames_at(0.0, 0.1), masks=True)
    assert torch.equal(next(images).static, torch.from_numpy(mask == 0))
    with pytest.raises(InputError, match=r"0\.100000\.png: is missing, damaged or of another size"):
        next(images)
