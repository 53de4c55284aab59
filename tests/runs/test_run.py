"""A run that writes its files."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers.short_wall import CAMERA, FRAMES, StoredWall, Wall, square

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.datasets import load_sequence
from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.frame_result import FrameResult
from v3d_torch.pipeline import pipeline as pipeline_module
from v3d_torch.pipeline.run_record import RunRecord
from v3d_torch.runs.metrics_file import read_metrics
from v3d_torch.runs.report_page import render_page
from v3d_torch.runs.request import RunRequest
from v3d_torch.runs.result_tables import ResultTables
from v3d_torch.runs.run import Run
from v3d_torch.runs.stored_run import read_run
from v3d_torch.segmentation import MaskFolder
from v3d_torch.segmentation.coco import PERSON
from v3d_torch.types import Instances, RGBDFrame, Segmenter


def test_poses_and_sparse_map_are_written_before_the_point_map_is_fused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without an autosave before, as in a short run."""

    def fuse_points(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(pipeline_module, "fuse_points", fuse_points)
    run = Run(RunRequest("wall", Config(), save_map=str(tmp_path / "room.npz")), Wall(), square, tmp_path)
    with pytest.raises(MemoryError):
        run(lambda *_: None)
    assert len(read_trajectory(tmp_path / "trajectory.txt")) == FRAMES
    assert {"states.parquet", "objects.parquet", "room.npz"} <= {path.name for path in tmp_path.iterdir()}
    failure = read_metrics(tmp_path / "metrics.json").failure
    assert failure == f"killed or still running after {FRAMES} of {FRAMES} frames"


@pytest.mark.usefixtures("undrawn")
def test_poses_and_tables_are_collected_and_written_once_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not once more after the fusion, which changes none of them."""
    written: list[Path] = []
    write = ResultTables.write

    def count(tables: ResultTables, folder: Path) -> None:
        written.append(folder)
        write(tables, folder)

    monkeypatch.setattr(ResultTables, "write", count)
    Run(RunRequest("wall", Config()), Wall(), square, tmp_path)(lambda *_: None)
    assert written == [tmp_path] and read_metrics(tmp_path / "metrics.json").failure is None


class WallWithoutDepth(Wall):
    """The wall as seen by a depth camera that measures nothing."""

    def __getitem__(self, index: int) -> RGBDFrame:
        frame = super().__getitem__(index)
        return RGBDFrame(frame.index, frame.stamp, frame.image, torch.zeros_like(frame.depth))


@pytest.mark.usefixtures("undrawn")
def test_more_landmarks_than_features_are_the_cause_of_a_lost_camera(moment: Path, tmp_path: Path) -> None:
    config = load_config(overrides=["mapping.min_tracked=900", "features.count=300"])
    run = Run(RunRequest("moment", config), load_sequence(str(moment)), MaskFolder(moment / "masks"), tmp_path)
    run(lambda *_: None)
    cause = r"at most 3\d\d features of an image have depth, and a map starts with mapping\.min_tracked=900; lower it"
    assert re.search(cause, str(run.pipeline.record.diagnosis))


def test_run_that_never_finds_the_camera_stores_the_cause_and_no_scores(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run = Run(RunRequest("wall", Config()), WallWithoutDepth(), square, tmp_path)
    with caplog.at_level(logging.ERROR, "v3d_torch"):
        assert run(lambda *_: None) is None
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert (metrics["ate"], metrics["lost"], metrics["failure"]) == (None, FRAMES, None)
    cause = f"wall: the camera was not found in any of the {FRAMES} frames"
    page = render_page(read_run(tmp_path))
    assert all(text.count(cause) == 1 for text in (metrics["diagnosis"], caplog.text, page))
    assert "ATE RMSE" not in page and "The camera was not found in any frame" in page


@pytest.mark.usefixtures("undrawn")
def test_run_that_ended_early_has_no_diagnosis(tmp_path: Path) -> None:
    """The frames that it lacks could be different."""

    def interrupt(frame: RGBDFrame, result: FrameResult) -> None:
        if frame.index == 3:
            raise KeyboardInterrupt

    run = Run(RunRequest("wall", Config()), WallWithoutDepth(), square, tmp_path)
    run(interrupt)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["failure"] == f"interrupted after 4 of {FRAMES} frames" and metrics["diagnosis"] is None


RunWall = Callable[..., RunRecord]


@pytest.fixture
def run_wall(undrawn: None, tmp_path: Path) -> RunWall:
    """Function that runs a sequence without figures and returns the record of the run."""

    def run_sequence(sequence: Wall, segment: Segmenter = square, overrides: tuple[str, ...] = ()) -> RunRecord:
        run = Run(RunRequest("wall", load_config(overrides=overrides)), sequence, segment, tmp_path)
        run(lambda *_: None)
        return run.pipeline.record

    return run_sequence


class Covered(StoredWall):
    """The wall as seen by a camera whose lens is covered after some frames."""

    def __init__(self, frames: int) -> None:
        super().__init__()
        self._frames = frames

    def __getitem__(self, index: int) -> RGBDFrame:
        frame = super().__getitem__(index)
        return frame if index < self._frames else replace(frame, image=torch.zeros_like(frame.image))


@pytest.mark.parametrize("frames", [1, 6])
def test_cause_of_the_loss_of_most_frames_is_a_warning(run_wall: RunWall, tmp_path: Path, frames: int) -> None:
    """The cause is that of the lost frames; it is no error, because the poses of the others are right."""
    run_wall(Covered(frames))
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    text = f"{FRAMES - frames} of {FRAMES} frames are lost: the colour images are uniform;"
    assert sum(warning.startswith(text) for warning in metrics["warnings"]) == 1 and metrics["diagnosis"] is None


class PartlyFar(StoredWall):
    """The wall in the dark in the first frames, and far beyond the maximum depth in the others."""

    def __init__(self, dark: int) -> None:
        super().__init__()
        self._dark = dark

    def __getitem__(self, index: int) -> RGBDFrame:
        frame = super().__getitem__(index)
        if index < self._dark:
            return replace(frame, image=torch.zeros_like(frame.image))
        return replace(frame, depth=20 * frame.depth)


class FarBehindNear(StoredWall):
    """The wall far beyond the maximum depth, behind something near that covers a third of the image."""

    def __getitem__(self, index: int) -> RGBDFrame:
        frame = super().__getitem__(index)
        depth = 20 * frame.depth
        depth[..., :107] = frame.depth[..., :107]
        return replace(frame, depth=depth)


def left_third(frame: RGBDFrame) -> Instances:
    mask = torch.zeros(1, *frame.depth.shape[1:], dtype=torch.bool)
    mask[..., :107] = True
    return Instances.from_masks(mask, torch.tensor([PERSON]))


class Strip(StoredWall):
    """A strip of the wall, 60 rows high."""

    camera = replace(CAMERA, height=60, cy=29.5)

    def __getitem__(self, index: int) -> RGBDFrame:
        frame = super().__getitem__(index)
        return replace(frame, image=frame.image[:, :60], depth=frame.depth[:, :60])


class Unrelated(StoredWall):
    """A wall that is painted anew for every frame."""

    def __getitem__(self, index: int) -> RGBDFrame:
        frame, generator = super().__getitem__(index), torch.Generator().manual_seed(index)
        blocks = torch.randint(0, 256, (3, 60, 80), generator=generator, dtype=torch.uint8)
        return replace(frame, image=blocks.repeat_interleave(4, dim=1).repeat_interleave(4, dim=2))


def no_instances(frame: RGBDFrame) -> Instances:
    return Instances.empty(*frame.depth.shape[1:])


def whole_image(frame: RGBDFrame) -> Instances:
    return Instances.from_masks(torch.ones(1, *frame.depth.shape[1:], dtype=torch.bool), torch.tensor([PERSON]))


@pytest.mark.parametrize(
    ("sequence", "segment", "overrides", "cause"),
    [
        (PartlyFar(0), square, (), f"nearly all depth is beyond {Config().features.max_depth:g} m; correct the camera"),
        (PartlyFar(FRAMES // 2), square, (), "at most 0 features of an image have depth"),  # no other cause of all
        (Strip(), no_instances, ("mapping.min_tracked=900",), "images of 320x60 pixels have too few features"),
    ],
    ids=["far", "partly dark and partly far", "small images"],
)
def test_diagnosis_names_the_cause_of_a_lost_camera(
    sequence: Wall, segment: Segmenter, overrides: tuple[str, ...], cause: str, run_wall: RunWall
) -> None:
    expected = f"wall: the camera was not found in any of the {FRAMES} frames, {cause}"
    assert str(run_wall(sequence, segment, overrides).diagnosis).startswith(expected)


def late_square(frame: RGBDFrame) -> Instances:
    return square(frame) if frame.index >= FRAMES - 3 else no_instances(frame)


def static_square(frame: RGBDFrame) -> Instances:
    return replace(square(frame), labels=torch.tensor([62]))  # a screen, which is never seen to move


@pytest.mark.parametrize(
    ("segment", "cause"),
    [
        (whole_image, "masked objects cover the images"),
        (late_square, "no features can be tracked between frames"),
        (static_square, "no features can be tracked between frames"),
    ],
)
def test_objects_are_the_cause_only_if_they_are_in_most_of_the_lost_frames(
    segment: Segmenter, cause: str, run_wall: RunWall
) -> None:
    warnings = run_wall(Unrelated(), segment).warnings
    assert any(f" of {FRAMES} frames are lost: {cause}" in each for each in warnings)


def test_depth_that_is_too_far_is_the_cause_also_behind_a_person(run_wall: RunWall) -> None:
    warnings = run_wall(FarBehindNear(), left_third).warnings
    cause = f"frames are lost: most depth is beyond {Config().features.max_depth:g} m; correct the camera's depth_scale"
    assert any(cause in each for each in warnings)


def test_loss_of_few_frames_has_no_warning(run_wall: RunWall) -> None:
    assert not any("are lost" in warning for warning in run_wall(Covered(FRAMES - 4)).warnings)
