"""A resumed run equals an uninterrupted one in every attribute, to the bit."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from helpers.differences import differences
from helpers.walk_with_loop import CONFIG, Walk, interrupt_after, make_pipeline, segment_red

from v3d_torch.errors import OutputError
from v3d_torch.frame_result import FrameResult
from v3d_torch.objects.frame_objects import MotionState
from v3d_torch.pipeline import Pipeline
from v3d_torch.runs import checkpoint as checkpoint_module
from v3d_torch.runs.autosave import Autosave
from v3d_torch.runs.checkpoint import FileSizes, describe_change, read_checkpoint, write_checkpoint
from v3d_torch.runs.request import RunRequest
from v3d_torch.runs.run import Run
from v3d_torch.runs.segmentation_files import SegmentationFiles
from v3d_torch.segmentation import UprightSegmenter
from v3d_torch.segmentation.coco import PERSON, UNLABELLED
from v3d_torch.segmentation.segmenter import segmenter_state_of
from v3d_torch.types import RGBDFrame, TrackingStatus

STOPS = (0, 1, 7, 8, 19, 22, 31, 32, 33, 45, 53)


@pytest.fixture(scope="module")
def uninterrupted() -> Pipeline:
    """Pipeline that has run without interruption."""
    pipeline = make_pipeline(prefetch=False)
    assert pipeline().failure is None
    return pipeline


def test_sequence_exercises_all_state(uninterrupted: Pipeline) -> None:
    slam, record = uninterrupted.slam, uninterrupted.record
    assert {TrackingStatus.TRACKED, TrackingStatus.LOST} <= set(slam.poses.statuses)
    assert slam.loop_closer.loop_count > 0 and len(slam.map.keyframes) > 10
    assert not slam.map.landmarks["active"].all()
    assert {PERSON, UNLABELLED} <= set(record.objects["label"].tolist())
    assert {MotionState.DYNAMIC, MotionState.STATIC} <= record.objects.count_motion_states().keys()
    assert record.objects["missed"].any() and record.objects["votes"].any()
    state = segmenter_state_of(slam.segment)
    assert state is not None and state["calls"] > 10 and state["up"].norm() > 1


def test_comparison_finds_differences_in_private_attributes() -> None:
    first, second = make_pipeline(prefetch=False), make_pipeline(prefetch=False)
    assert list(differences(first, second, "run", {})) == []
    second.slam.mapper._most_tracked = 3
    second.slam.classify_motion._tracker._next_id = 4
    assert len(list(differences(first, second, "run", {}))) == 2


def test_run_resumed_many_times_equals_an_uninterrupted_run(uninterrupted: Pipeline, tmp_path: Path) -> None:
    """With prefetching, so that the segmenter is some frames ahead of the saved state."""
    request = RunRequest("walk", CONFIG.model_copy(update={"prefetch": True}), save_masks=True)
    pipeline = make_pipeline(prefetch=True)
    for stop in STOPS:
        record = pipeline(interrupt_after(stop))
        assert record.failure == f"interrupted after {stop + 1} of {len(Walk())} frames"
        assert pipeline.between_frames
        files = SegmentationFiles(None, pipeline.slam.segment, pipeline.sequence)
        write_checkpoint(tmp_path, pipeline, request, FileSizes(pipeline.sequence), files)
        checkpoint = read_checkpoint(tmp_path)
        assert (checkpoint.frames, checkpoint.request.config) == (stop + 1, pipeline.slam.config)
        assert checkpoint.request == request.absolute() and checkpoint.request.save_masks
        pipeline = make_pipeline(prefetch=True)
        assert describe_change(checkpoint, pipeline.sequence) is None
        pipeline.load_state_dict(checkpoint.state)
    assert pipeline().failure is None
    assert list(differences(uninterrupted, pipeline, "pipeline", {})) == []
    slam, expected = pipeline.slam, uninterrupted.slam
    assert torch.equal(slam.poses.trajectory().T_wc, expected.poses.trajectory().T_wc)
    assert set(slam.timer.seconds) == set(expected.timer.seconds)
    assert pipeline.record.times.indices.tolist() == list(range(len(Walk())))
    # The database of loop closing is rebuilt and gives the same candidates.
    query = expected.map.keyframes[3].features.descriptors
    assert slam.loop_closer._database.query(query, 9) == expected.loop_closer._database.query(query, 9)


@pytest.mark.usefixtures("undrawn")
def test_run_whose_results_cannot_be_written_when_interrupted_resumes_exactly(
    tmp_path: Path,
) -> None:
    folder, request = tmp_path / "out", RunRequest("walk", CONFIG)
    whole, again = tmp_path / "whole", tmp_path / "again"
    for each in (folder, whole, again):
        each.mkdir()
    walk = Walk(24)
    Run(request, walk, UprightSegmenter(segment_red), whole)(lambda *_: None)
    run = Run(request, walk, UprightSegmenter(segment_red), folder)

    def interrupt(frame: RGBDFrame, result: FrameResult) -> None:
        if frame.index >= 8 and run.pipeline.slam.back_end.keyframe is not None:
            (folder / "map.ply").mkdir()
            raise KeyboardInterrupt

    with pytest.raises(OutputError, match=r"map\.ply"):
        run(interrupt)
    checkpoint = read_checkpoint(folder)
    Run(request, walk, UprightSegmenter(segment_red), again, checkpoint=checkpoint)(lambda *_: None)
    for name in ("trajectory.txt", "keyframes.txt", "objects.parquet", "map.ply"):
        assert (again / name).read_bytes() == (whole / name).read_bytes(), name


def test_next_checkpoint_reads_the_sizes_of_new_files_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = list[int]()
    there, missing = tmp_path / "there.png", tmp_path / "missing.png"
    there.write_bytes(b"123")

    def files(_: object, index: int) -> tuple[Path, ...]:
        asked.append(index)
        return there, missing

    monkeypatch.setattr(checkpoint_module, "_files", files)
    pipeline = make_pipeline(prefetch=False)
    autosave = Autosave(tmp_path, pipeline, RunRequest("walk", CONFIG))
    for stop in (2, 4):
        pipeline(interrupt_after(stop))
        autosave.end()
        assert asked == list(range(stop + 1))
    assert read_checkpoint(tmp_path).sequence["sizes"] == [[3, None]] * 5


def test_error_of_a_checkpoint_is_removed_when_the_next_one_is_saved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    pipeline = make_pipeline(prefetch=False)
    autosave = Autosave(tmp_path, pipeline, RunRequest("walk", CONFIG))
    pipeline(interrupt_after(2))

    def refuse(*_: object) -> None:
        raise OutputError("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr("v3d_torch.runs.autosave.write_checkpoint", refuse)
        for _ in range(2):
            autosave.end()
            assert pipeline.record.save_error == "the disk is full"
        assert [record.getMessage() for record in caplog.records] == ["no checkpoint: the disk is full"]
    autosave.end()
    assert pipeline.record.save_error is None
    assert read_checkpoint(tmp_path).state["record"].save_error is None
