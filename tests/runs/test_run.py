"""A run that writes its files."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers.wall_run import FRAMES, Wall, square

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.datasets import load_sequence
from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.pipeline import pipeline as pipeline_module
from v3d_torch.runs.metrics_file import read_metrics
from v3d_torch.runs.report_page import render_page
from v3d_torch.runs.request import RunRequest
from v3d_torch.runs.result_tables import ResultTables
from v3d_torch.runs.run import Run
from v3d_torch.runs.stored_run import read_run
from v3d_torch.segmentation import MaskFolder
from v3d_torch.types import RGBDFrame


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
    assert {"states.parquet", "dynamics.parquet", "room.npz"} <= {path.name for path in tmp_path.iterdir()}
    failure = read_metrics(tmp_path / "metrics.json").failure
    assert failure == f"killed or still running after {FRAMES} of {FRAMES} frames"


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


class Covered(Wall):
    """The wall as seen by a camera whose lens is covered after some frames."""

    def __init__(self, frames: int) -> None:
        super().__init__()
        self._frames = frames

    def __iter__(self) -> Iterator[RGBDFrame]:
        return map(self.__getitem__, range(FRAMES))

    def __getitem__(self, index: int) -> RGBDFrame:
        frame = super().__getitem__(index)
        return frame if index < self._frames else replace(frame, image=torch.zeros_like(frame.image))


@pytest.mark.parametrize("frames", [1, 6])
def test_cause_of_the_loss_of_most_frames_is_a_warning(tmp_path: Path, frames: int) -> None:
    """The cause is that of the lost frames; it is no error, because the poses of the others are right."""
    run = Run(RunRequest("wall", Config()), Covered(frames), square, tmp_path)
    run(lambda *_: None)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    text = f"{FRAMES - frames} of {FRAMES} frames are lost: the colour images are uniform;"
    assert sum(warning.startswith(text) for warning in metrics["warnings"]) == 1 and metrics["diagnosis"] is None


def test_loss_of_few_frames_has_no_warning(tmp_path: Path) -> None:
    run = Run(RunRequest("wall", Config()), Covered(FRAMES - 4), square, tmp_path)
    run(lambda *_: None)
    assert not any("are lost" in warning for warning in run.pipeline.record.warnings)
