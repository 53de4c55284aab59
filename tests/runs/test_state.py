"""`save_state` and `load_state`: a loaded system continues like the saved one, to the bit."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.differences import differences
from helpers.walk_with_loop import CAMERA, CONFIG, Walk, interrupt_after, make_pipeline, segment_red

from v3d_torch import V3DSLAM, load_state, save_state
from v3d_torch.config.loading import load_config
from v3d_torch.errors import ConfigError, InputError, OutputError, StageWarning
from v3d_torch.io.state_file import write_state
from v3d_torch.objects.feature_shift import FeatureShift
from v3d_torch.runs.checkpoint import FileSizes, write_checkpoint
from v3d_torch.runs.file_names import RunFile
from v3d_torch.runs.request import RunRequest
from v3d_torch.runs.segmentation_files import SegmentationFiles
from v3d_torch.segmentation import NoSegmentation, UprightSegmenter
from v3d_torch.segmentation.segmenter import segmenter_state_of
from v3d_torch.types import Instances, RGBDFrame


def test_loaded_system_equals_the_saved_one(tmp_path: Path) -> None:
    config = load_config(overrides=["segmentation.source=none", "features.count=300"])
    walk, uninterrupted, saved = Walk(), V3DSLAM(CAMERA, config=config), V3DSLAM(CAMERA, config=config)
    for frame in (walk[0], walk[1], walk[2]):
        uninterrupted(frame), saved(frame)
    save_state(tmp_path / "slam.state", saved)
    loaded = load_state(tmp_path / "slam.state")
    assert loaded.camera == CAMERA
    for frame in (walk[3], walk[4]):
        assert torch.equal(loaded(frame).T_wc, uninterrupted(frame).T_wc)
    assert loaded.config == config and list(differences(uninterrupted, loaded, "slam", {})) == []


@pytest.mark.parametrize("saved_after", [0, 1, 14, 24, 38])
def test_loaded_system_gives_the_same_next_results(saved_after: int, tmp_path: Path) -> None:
    """With objects, a stateful segmenter, a lost camera and a pending keyframe."""
    config, walk = CONFIG.model_copy(update={"prefetch": False}), Walk()
    slam = V3DSLAM(CAMERA, UprightSegmenter(segment_red), config)
    for index in range(saved_after):
        slam(walk[index])
    save_state(tmp_path / "slam.state", slam)
    loaded = load_state(tmp_path / "slam.state", UprightSegmenter(segment_red))
    assert list(differences(slam.state_dict(), loaded.state_dict(), "state", {})) == []
    for index in range(saved_after, saved_after + 8):
        assert list(differences(slam(walk[index]), loaded(walk[index]), f"frame {index}", {})) == []
    slam.flush(), loaded.flush()
    assert list(differences(slam, loaded, "slam", {})) == []


def test_state_has_the_shifts_of_features(tmp_path: Path) -> None:
    slam, walk = V3DSLAM(CAMERA, segment_red, CONFIG), Walk()
    for index in range(3):
        slam(walk[index])
    (track, *_) = slam.classify_motion._tracker.tracks
    track.motion.add_shift(track.newest.stamp, FeatureShift((3.0, 4.0), 0.5, torch.rand(12, 2)), 0.3)
    save_state(tmp_path / "slam.state", slam)
    loaded = load_state(tmp_path / "slam.state", segment_red)
    assert list(differences(slam.state_dict(), loaded.state_dict(), "state", {})) == []


def test_state_from_before_the_first_frame_also_restores_the_segmenter() -> None:
    walk, slam = Walk(), V3DSLAM(CAMERA, UprightSegmenter(segment_red), CONFIG)
    start, votes = copy.deepcopy(slam.state_dict()), segmenter_state_of(slam.segment)
    for index in range(3):
        slam(walk[index])
    slam.load_state_dict(start)
    assert list(differences(votes, segmenter_state_of(slam.segment), "votes", {})) == []


def test_state_after_the_segmenter_is_replaced_is_that_of_the_new_one() -> None:
    walk, slam = Walk(), V3DSLAM(CAMERA, UprightSegmenter(segment_red), CONFIG)
    slam(walk[0])
    slam.segment = UprightSegmenter(segment_red)
    votes = segmenter_state_of(slam.segment)
    assert list(differences(votes, slam.state_dict()["segmenter"], "votes", {})) == []
    slam.segment = segment_red
    assert slam.state_dict()["segmenter"] is None


def test_segmenter_of_one_system_does_not_change_the_results_of_another() -> None:
    walk, first, alone = Walk(), *(V3DSLAM(CAMERA, UprightSegmenter(segment_red), CONFIG) for _ in range(2))
    first(walk[0])
    second = V3DSLAM(CAMERA, first.segment, CONFIG)
    for index in range(3):
        second(walk[index]), alone(walk[index])
    assert list(differences(segmenter_state_of(alone.segment), segmenter_state_of(second.segment), "votes", {})) == []


def test_stages_that_are_not_in_the_file_are_named(tmp_path: Path) -> None:
    slam = V3DSLAM(CAMERA, NoSegmentation(), CONFIG)
    slam.smooth_depth = lambda depth: depth
    save_state(tmp_path / "slam.state", slam)
    with pytest.warns(StageWarning, match=r"that are not in the file: smooth_depth; set them again before the next"):
        load_state(tmp_path / "slam.state", NoSegmentation())


@pytest.mark.parametrize("stage", ["mapper", "classify_motion", "free_space_check"])
def test_system_with_a_replaced_stage_without_state_is_not_saved(stage: str, tmp_path: Path) -> None:
    slam = V3DSLAM(CAMERA, NoSegmentation(), CONFIG)
    setattr(slam, stage, lambda *_: None)
    with pytest.raises(ConfigError, match=f"^{stage} was replaced by a stage without state_dict; its state cannot be"):
        save_state(tmp_path / "slam.state", slam)
    assert list(tmp_path.iterdir()) == []


def test_checkpoint_is_not_loaded_as_the_state_of_a_system(tmp_path: Path) -> None:
    pipeline = make_pipeline(prefetch=False)
    pipeline(interrupt_after(1))
    files = SegmentationFiles(None, pipeline.slam.segment, pipeline.sequence)
    write_checkpoint(tmp_path, pipeline, RunRequest("walk", CONFIG), FileSizes(pipeline.sequence), files)
    with pytest.raises(InputError, match=rf"{RunFile.CHECKPOINT}: is "):
        load_state(tmp_path / RunFile.CHECKPOINT)


def test_file_without_the_state_of_a_system_is_rejected(tmp_path: Path) -> None:
    write_state(tmp_path / "slam.state", {"about": "a test"}, {"value": 1})
    with pytest.raises(
        InputError, match=r"slam\.state: is not the state of a system; pass a file that save_state wrote"
    ):
        load_state(tmp_path / "slam.state")


@pytest.mark.parametrize("kind", [np.int64, np.uint8])
def test_frames_with_numbers_of_numpy_leave_a_state_that_can_be_loaded(tmp_path: Path, kind: type) -> None:
    slam = V3DSLAM(CAMERA, segment_red)
    for index in range(3):
        frame = Walk()[index]
        slam(replace(frame, index=kind(index), stamp=np.float32(frame.stamp), depth_delay=np.float64(0)))
    save_state(tmp_path / "slam.state", slam)
    loaded = load_state(tmp_path / "slam.state", segment_red)
    assert loaded.poses.stamp == slam.poses.stamp and type(loaded.poses.stamp) is float


def test_state_that_cannot_be_loaded_is_not_saved(tmp_path: Path) -> None:
    class Remembering:
        def __call__(self, frame: RGBDFrame) -> Instances:
            return segment_red(frame)

        def state_dict(self) -> dict[str, object]:
            return {"last": np.ones(3)}

        def load_state_dict(self, state: object) -> None:
            pass

    slam = V3DSLAM(CAMERA, Remembering())
    slam(Walk()[0])
    with pytest.raises(OutputError, match=r"slam\.state: the state has objects that cannot be loaded again \(numpy"):
        save_state(tmp_path / "slam.state", slam)
    assert list(tmp_path.iterdir()) == []
