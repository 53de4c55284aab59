"""The pipeline: its results, callback and record; runs that end early; mask images."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from helpers import long_wall
from helpers.moving_camera import keyframe
from helpers.short_wall import CAMERA, FRAMES, WALL, StoredWall, Wall, make_pipeline, run_along_wall, square
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.datasets.broken_frames import max_broken_frames
from v3d_torch.datasets.readable_frames import BrokenFrame
from v3d_torch.datasets.realtime_playback import RealtimePlayback
from v3d_torch.errors import InputError
from v3d_torch.frame_result import FrameResult
from v3d_torch.mapping.static_views import StaticViews
from v3d_torch.objects.frame_objects import FrameObjects, MotionState, TrackedObject
from v3d_torch.pipeline import Pipeline
from v3d_torch.pipeline.run_record import Snapshot
from v3d_torch.reconstruction.point_map import PointMap
from v3d_torch.runs.results import write_results
from v3d_torch.segmentation.coco import PERSON
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import RGBDFrame, TrackingStatus


def test_run_along_the_wall_is_accurate() -> None:
    run = run_along_wall()
    assert run.slam.poses.statuses == [TrackingStatus.TRACKED] * FRAMES
    truth = run.sequence.groundtruth
    assert truth is not None
    error = (run.slam.poses.trajectory().T_wc - truth.T_wc)[:, :3, 3].norm(dim=1)
    assert error.max() < 0.01
    assert run.record.failure is None and run.record.seconds > 0


def test_callback_and_record_have_every_frame_and_object() -> None:
    reported: list[tuple[int, int, TrackingStatus]] = []

    def on_frame(frame: RGBDFrame, result: FrameResult) -> None:
        reported.append((frame.index, len(result.objects), result.status))

    pipeline = make_pipeline()
    record = pipeline(on_frame)
    assert reported == [(index, 1, TrackingStatus.TRACKED) for index in range(FRAMES)]
    assert record.objects["frame"].tolist() == list(range(FRAMES))
    assert set(record.objects["label"].tolist()) == {PERSON}
    assert float(record.objects["centroid"][-1, 2]) == pytest.approx(WALL, abs=0.02)
    assert (stamps := [snapshot.frame.stamp for snapshot in record.snapshots]) == sorted(stamps)
    assert len(record.snapshots) == 6
    assert set(pipeline.slam.timer.seconds) >= {"read", "segmentation", "objects", "tracking", "mapping"}
    assert max(pipeline.slam.timer.seconds.values()) <= record.seconds


def test_time_of_the_run_does_not_contain_the_comparison_with_true_masks() -> None:
    class MaskedWall(Wall):
        def motion_mask(self, index: int) -> Tensor:
            time.sleep(0.05)
            return torch.zeros(240, 320, dtype=torch.uint8)

    pipeline = make_pipeline(MaskedWall())
    begin = time.perf_counter()
    record = pipeline()
    assert record.mask_evaluation.compute_scores() is not None
    assert 0 < record.seconds < time.perf_counter() - begin - 0.05 * FRAMES


def test_time_of_a_resumed_run_contains_that_before() -> None:
    """Also in its checkpoints, which are saved after a frame."""
    pipeline, seconds = make_pipeline(), list[float]()
    pipeline.record.seconds = 100.0
    record = pipeline(lambda *_: seconds.append(pipeline.record.seconds))
    assert len(seconds) == FRAMES and sorted([100.0, *seconds, record.seconds]) == [100.0, *seconds, record.seconds]


def test_run_whose_frame_failed_is_not_between_frames() -> None:
    """No checkpoint can be saved, because the frame may have changed a part of the state."""
    pipeline = make_pipeline()

    def fail(*_: object) -> None:
        if len(pipeline.slam.poses) == 4:
            raise ZeroDivisionError

    with pipeline.slam.register_stage_hook("odometry", fail):
        assert "ZeroDivisionError" in str(pipeline().failure)
    assert len(pipeline.slam.poses) == 4 and not pipeline.between_frames


def test_true_masks_are_not_read_after_the_first_that_cannot_be_read() -> None:
    """The scores are then not those of the whole sequence, and the first error is reported."""
    asked: list[int] = []

    class DamagedMasks(Wall):
        def motion_mask(self, index: int) -> Tensor:
            asked.append(index)
            if index >= 2:
                raise InputError(f"mask {index}: is damaged")
            return torch.zeros(240, 320, dtype=torch.uint8)

    record = make_pipeline(DamagedMasks())()
    assert asked == [0, 1, 2] and record.mask_error == "mask 2: is damaged" and record.failure is None


def test_snapshots_of_a_stream_that_drops_frames_reach_from_its_first_to_its_last_frames() -> None:
    wall, mask = Wall(), torch.ones(240, 320, dtype=torch.bool)
    frame, nothing = wall[0], cast("FrameResult", FrameObjects([], mask, mask, []))
    pipeline = Pipeline(RealtimePlayback(wall), V3DSLAM(CAMERA, square))
    for number in range(900):
        pipeline.slam = cast("V3DSLAM", SimpleNamespace(poses=range(number + 1)))
        pipeline._keep_snapshot(Snapshot(replace(frame, index=2 * number + 1), torch.eye(4), nothing))
    kept = [snapshot.frame.index // 2 for snapshot in pipeline.record.snapshots]
    assert kept == list(range(0, 900, 128))


def test_snapshots_of_a_stored_sequence_are_in_the_middle_of_equal_parts() -> None:
    mask, pipeline = torch.ones(240, 320, dtype=torch.bool), make_pipeline()
    frame, nothing = Wall()[0], cast("FrameResult", FrameObjects([], mask, mask, []))
    pipeline.sequence = cast("Wall", range(24))
    for number in range(24):
        pipeline.slam = cast("V3DSLAM", SimpleNamespace(poses=range(number + 1)))
        pipeline._keep_snapshot(Snapshot(replace(frame, index=number), torch.eye(4), nothing))
    assert [snapshot.frame.index for snapshot in pipeline.record.snapshots] == [2, 6, 10, 14, 18, 22]


def test_most_dynamic_snapshot_has_the_most_votes_for_dynamic_objects_then_the_most_objects() -> None:
    mask, pipeline = torch.ones(240, 320, dtype=torch.bool), make_pipeline()
    states = {1: MotionState.DYNAMIC, 2: MotionState.STATIC, 3: MotionState.STATIC}
    objects = [cast("TrackedObject", SimpleNamespace(id=id, motion_state=state)) for id, state in states.items()]
    votes = [
        (objects, [(1, 2), (1, 3), (2, 1)]),
        (objects[:2], [(2, 1), (3, 1)]),
        (objects, [(1, 2), (2, 1), (3, 1)]),
        (objects, [(2, 1), (3, 1)]),
        (objects, [(1, 2), (1, 3), (2, 3), (3, 2)]),
    ]
    most_dynamic = []
    for index, (found, pairs) in enumerate(votes):
        result = cast("FrameResult", FrameObjects(found, mask, mask, pairs))
        pipeline._keep_snapshot(Snapshot(replace(Wall()[0], index=index), torch.eye(4), result))
        most_dynamic.append(cast("Snapshot", pipeline.record.most_dynamic_snapshot).frame.index)
    assert most_dynamic == [0, 1, 2, 2, 2]


def test_warning_is_logged_and_recorded_once(caplog: pytest.LogCaptureFixture) -> None:
    pipeline = make_pipeline()
    pipeline.warn(["dark", "blurred", "dark"])
    pipeline.warn(["dark", "red and blue are exchanged"])
    assert pipeline.record.warnings == caplog.messages == ["dark", "blurred", "red and blue are exchanged"]


@pytest.mark.parametrize("broken", [0, 1, 5])
def test_broken_frame_ends_the_run_and_keeps_the_frames_before(broken: int, tmp_path: Path) -> None:
    pipeline = make_pipeline(Wall(broken=broken))
    record = pipeline()
    assert record.failure is not None and "truncated" in record.failure
    pipeline.flush()
    evaluation = write_results(tmp_path, pipeline)
    lines = (tmp_path / "trajectory.txt").read_text().splitlines()
    assert len(lines) == broken
    assert (evaluation is not None) == (broken >= 3)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert (metrics["processed"], metrics["frames"]) == (broken, FRAMES)
    assert metrics["failure"] == record.failure
    assert (tmp_path / "map.ply").is_file() and (tmp_path / "objects.parquet").is_file()


@pytest.mark.usefixtures("undrawn")
def test_interrupt_ends_the_run_and_keeps_the_frames_before(tmp_path: Path) -> None:
    pipeline = make_pipeline(Wall(interrupted=4))
    assert pipeline().failure == f"interrupted after 4 of {FRAMES} frames"
    pipeline.flush()
    write_results(tmp_path, pipeline)
    assert len((tmp_path / "trajectory.txt").read_text().splitlines()) == 4


def test_broken_frames_before_a_run_was_resumed_count_towards_the_limit() -> None:
    broken = [BrokenFrame(0, "is damaged")] * max_broken_frames(FRAMES)
    for earlier, failed in ((broken[1:], False), (broken, True)):
        pipeline = Pipeline(StoredWall(broken=3), V3DSLAM(CAMERA, square), skip_broken=True)
        pipeline.record.broken = list(earlier)
        failure = pipeline().failure
        assert (failure is not None and "--skip-broken skips at most" in failure) is failed


def test_mask_images_show_the_masked_pixels(tmp_path: Path) -> None:
    no_margins = [
        *("objects.clouds.stride=1", "objects.static_mask.depth_margin=0", "objects.static_mask.dilation=0"),
        "objects.static_mask.surface_margin=0",
        "objects.free_space.enabled=false",
    ]
    config = load_config(overrides=[*no_margins, "objects.static_mask.confirm_static_time=100"])
    make_pipeline(masks=tmp_path / "masks", config=config)()
    paths = sorted((tmp_path / "masks").iterdir())
    assert [path.name for path in paths] == [f"{index / 10:.6f}.png" for index in range(FRAMES)]
    for path in paths:
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert image.dtype == np.uint8
        assert np.array_equal(image, np.where(square(Wall()[0]).masks[0].numpy(), 255, 0))


@pytest.mark.usefixtures("undrawn")
def test_frame_that_is_interrupted_after_its_pose_was_stored_has_no_row_in_the_tables(tmp_path: Path) -> None:
    pipeline = make_pipeline()

    def interrupt(*_: object) -> None:
        if len(pipeline.slam.poses) == 5:
            raise KeyboardInterrupt

    with pipeline.slam.register_stage_hook("estimate_state", interrupt):
        pipeline()
    assert len(pipeline.slam.poses) == 5
    pipeline.flush()
    write_results(tmp_path, pipeline)
    for name in ("frames", "states", "objects"):
        assert len(pq.read_table(tmp_path / f"{name}.parquet")) == 4, name


class DelayedWall(Wall):
    """The wall, whose depth images are taken 10 ms after the colour images."""

    def __getitem__(self, index: int) -> RGBDFrame:
        return replace(super().__getitem__(index), depth_delay=0.01)


def assert_is_square(mask: Tensor, margin: int) -> None:
    """Check that a mask is the segmented square with a margin, up to the rounded corners of the margin."""
    rows, columns = slice(90 - margin, 150 + margin), slice(130 - margin, 190 + margin)
    outside = mask.clone()
    outside[rows, columns] = False
    assert not outside.any()
    assert mask[rows, 140:180].all() and mask[100:140, columns].all()


def test_maps_leave_out_more_pixels_than_tracking_in_mask_images_and_views(tmp_path: Path) -> None:
    """Maps have a larger margin around people. The views also have the delay of their depth.

    The wall is at the depth of the person, so that the mask of the person grows by 4 pixels, half of the depth margin
    for images of 640 columns. It is dilated by two pixels, half of the dilation for maps, or by one pixel for tracking.
    Without earlier views, the wall could be a part of the person.
    """
    results: dict[float, FrameResult] = {}
    alone = ["objects.free_space.enabled=false", "objects.static_mask.surface_margin=0"]
    slam = V3DSLAM(CAMERA, square, load_config(overrides=["mapping.max_keyframe_interval=5", *alone]))
    pipeline = Pipeline(DelayedWall(), slam, tmp_path / "masks", map_masks=tmp_path / "map_masks")
    pipeline(lambda frame, result: results.update({frame.stamp: result}))
    assert len(results) == FRAMES and len(pipeline.views) > 1
    for stamp, result in results.items():
        assert bool((result.static_mask & ~result.map_mask).any())
        assert_is_square(~result.map_mask, margin=6)
        if result.objects[0].motion_state is MotionState.STATIC:
            assert result.static_mask.all()
        else:
            assert_is_square(~result.static_mask, margin=5)
        for folder, static in (("masks", result.static_mask), ("map_masks", result.map_mask)):
            image = cv2.imread(str(tmp_path / folder / f"{stamp:.6f}.png"), cv2.IMREAD_UNCHANGED)
            assert np.array_equal(image == 0, static.numpy())
    for view in pipeline.views:
        static = results[view.keyframe.stamp].map_mask
        assert torch.equal(view.depth > 0, static[:: pipeline.views.stride, :: pipeline.views.stride])
        assert view.depth_delay == 0.01


def test_occupancy_map_is_corrected_with_the_final_poses() -> None:
    pipeline = run_along_wall("occupancy.enabled=true")
    slam, further = pipeline.slam, torch.eye(4, dtype=torch.float64)
    slam.flush()
    further[2, 3] = -1.0
    slam.map.move_keyframes(slam.map.T_cw @ further)
    pipeline.flush()
    assert slam.occupancy is not None
    assert (slam.occupancy.map.occupied_points[:, 2] - (WALL + 1)).abs().max() < 0.1


def test_masks_that_cannot_be_written_end_the_run_with_a_message(tmp_path: Path) -> None:
    (tmp_path / "masks").write_text("")
    failure = make_pipeline(masks=tmp_path / "masks")().failure
    assert failure is not None and "masks" in failure and "cannot be written" in failure


def record_checks(pipeline: Pipeline, monkeypatch: pytest.MonkeyPatch, keyframes: int) -> list[int]:
    """Let the camera be checked after some keyframes; return a list that gets the number of frames at each check."""
    checked: list[int] = []

    def check(*_: object) -> list[str]:
        checked.append(len(pipeline.slam.poses))
        return []

    monkeypatch.setattr("v3d_torch.pipeline.pipeline.check_plausibility", check)
    monkeypatch.setattr("v3d_torch.pipeline.pipeline._CHECKED_KEYFRAMES", keyframes)
    return checked


@pytest.mark.parametrize("live", [False, True])
def test_camera_is_checked_during_a_stored_run_and_after_a_live_one(
    live: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A check takes longer than a frame."""
    wall = Wall()
    pipeline = Pipeline(RealtimePlayback(wall) if live else wall, V3DSLAM(wall.camera, square, Config()))
    checked = record_checks(pipeline, monkeypatch, keyframes=1)
    pipeline()
    assert checked == ([] if live else [1])
    pipeline.flush()
    assert checked == ([len(pipeline.slam.poses)] if live else [1])


def test_camera_is_checked_when_its_own_run_has_enough_keyframes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Views of a known map can be of another camera, and say nothing about this one."""
    slam = V3DSLAM(CAMERA, square, load_config(overrides=["mapping.max_keyframe_interval=5"]))
    views = StaticViews(CAMERA, slam.config.dense_map.stride)
    for _ in range(3):
        earlier = replace(keyframe(), frame=-1)
        views.add(earlier, Wall()[0].image, Wall()[0].depth, torch.ones(240, 320, dtype=torch.bool))
    pipeline = Pipeline(Wall(), slam, views=views)
    checked = record_checks(pipeline, monkeypatch, keyframes=2)
    pipeline()
    assert checked == [6]  # frames 0 and 5 became keyframes


def test_part_of_the_map_whose_place_is_a_guess_is_uncertain_and_not_in_the_point_map() -> None:
    config = load_config(None, ("segmentation.source=none", "mapping.restart_after=0.3"))
    pipeline = Pipeline(long_wall.Jump(), V3DSLAM(long_wall.CAMERA, config=config))
    results: list[FrameResult] = []
    pipeline(lambda frame, result: results.append(result))
    pipeline.flush()
    points = pipeline.fuse_points().points
    disconnected = [each for each in results if each.status is TrackingStatus.DISCONNECTED]
    assert len(disconnected) > 10
    for each in disconnected:  # a few tenths of a second after the last frame that was found
        assert each.covariance[:3, :3].diagonal().sqrt().min() > 0.2
    first, last = (long_wall.DISTANCE / long_wall.CAMERA.fx * column for column in (-159.5, 200 + 160.5))
    assert len(points) > 1000 and first - 0.05 < points[:, 0].min() and points[:, 0].max() < last + 0.05
    (warning,) = [each for each in pipeline.record.warnings if "only a guess" in each]
    count = pipeline.slam.poses.statuses.count(TrackingStatus.DISCONNECTED)
    assert count >= len(disconnected) and warning.startswith(f"{count} of {len(results)} frames")


def test_time_of_the_viewer_belongs_to_the_frame_that_it_shows() -> None:
    """It was that of the next frame, and that of the last frame was lost."""

    class SlowViewer:
        def show(self, frame: RGBDFrame, objects: FrameObjects, slam: V3DSLAM, stage_times: object) -> None:
            with slam.timer("viewer"):
                time.sleep(0.05 * (frame.index in (1, FRAMES - 1)))

        def finish(self, slam: V3DSLAM, point_map: PointMap) -> None:
            pass

    pipeline = Pipeline(Wall(), V3DSLAM(CAMERA, square), viewer=SlowViewer())
    times = pipeline().times
    slow = times.wall[:, times.stages.index("viewer")] > 0.04
    assert torch.nonzero(slow)[:, 0].tolist() == [1, FRAMES - 1]
