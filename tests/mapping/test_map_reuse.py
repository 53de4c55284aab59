"""Runs in a map of an earlier run: relocalisation, localisation only, and extension of the map."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers.long_wall import CAMERA, Slide
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.errors import ConfigError
from v3d_torch.geometry.se3 import invert, se3_log
from v3d_torch.mapping.map_io import StoredMap, load_map, save_map
from v3d_torch.odometry.rolling_shutter import Readout
from v3d_torch.pipeline import Pipeline
from v3d_torch.segmentation.factory import NoSegmentation
from v3d_torch.slam import V3DSLAM
from v3d_torch.stages.frame_preprocessor import PREFETCHED_FRAMES
from v3d_torch.types import Instances, RGBDFrame, TrackingStatus

FAST = ["segmentation.source=none", "features.count=800"]  # enough features for a wall with a random texture
CONFIG, LOCALISE = load_config(overrides=FAST), load_config(overrides=[*FAST, "mapping.enabled=false"])


def run(sequence: Slide, config: Config = CONFIG, known: StoredMap | None = None) -> Pipeline:
    """Run the whole sequence, in a map of an earlier run if one is given."""
    slam = V3DSLAM(CAMERA, NoSegmentation(), config, None if known is None else known.map)
    pipeline = Pipeline(sequence, slam, views=None if known is None else known.views)
    assert pipeline().failure is None
    return pipeline


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Pipeline]:
    """A map file of the wall from column 640 to 960 + 320, and the run that created it."""
    made = run(Slide(640, 960, step=10))
    path = tmp_path_factory.mktemp("maps") / "wall.map"
    save_map(path, made.slam.mapper.map, made.views)
    return path, made


def position_errors(pipeline: Pipeline, slide: Slide) -> Tensor:
    """Position error of each frame, metres; the world frame is the first camera frame of the map, at column 640."""
    T_wm = Slide(640, 640).T_wc[0]
    return (pipeline.slam.poses.trajectory().T_wc - invert(T_wm) @ slide.T_wc)[:, :3, 3].norm(dim=1)


def test_relocalisation_in_a_loaded_map_equals_the_original_run(wall: tuple[Path, Pipeline]) -> None:
    path, made = wall
    stored = load_map(path, CAMERA, CONFIG)
    fresh = V3DSLAM(CAMERA, NoSegmentation(), CONFIG, stored.map)
    frame = Slide(800, 803, step=3)[1]
    features = fresh.detect_features(frame.image, frame.depth)
    before = made.slam.loop_closer.relocalise(features, made.slam.mapper.map)
    after = fresh.loop_closer.relocalise(features, fresh.mapper.map)
    assert before is not None and after is not None
    assert after.keyframe.index == before.keyframe.index
    assert torch.equal(after.tracking.T_cw, before.tracking.T_cw)
    # The same landmarks, whose ids are new because the file leaves out those that are not in use.
    own, other = after.tracking.landmarks, before.tracking.landmarks
    is_matched = own >= 0
    assert torch.equal(is_matched, other >= 0)
    assert torch.equal(
        fresh.map.landmarks["point"][own[is_matched]], made.slam.map.landmarks["point"][other[is_matched]]
    )


def test_localisation_tracks_every_frame_and_leaves_the_map_unchanged(
    wall: tuple[Path, Pipeline], tmp_path: Path
) -> None:
    path, _ = wall
    back = Slide(940, 660, step=20)
    second = run(back, LOCALISE, load_map(path, CAMERA, LOCALISE))
    assert second.slam.poses.statuses == [TrackingStatus.TRACKED] * len(back)
    assert position_errors(second, back).max() < 0.01
    save_map(tmp_path / "after.map", second.slam.mapper.map, second.views)
    assert (tmp_path / "after.map").read_bytes() == path.read_bytes()


def test_second_run_extends_the_map(wall: tuple[Path, Pipeline], tmp_path: Path) -> None:
    path, made = wall
    onward = Slide(900, 1260, step=12)
    second = run(onward, CONFIG, load_map(path, CAMERA, CONFIG))
    assert second.slam.poses.statuses == [TrackingStatus.TRACKED] * len(onward)
    assert position_errors(second, onward).max() < 0.03
    keyframes, before = second.slam.mapper.map.keyframes, len(made.slam.mapper.map.keyframes)
    assert len(keyframes) > before
    assert [keyframe.is_from_earlier_run for keyframe in keyframes] == before * [True] + (len(keyframes) - before) * [
        False
    ]
    assert second.slam.map.own_keyframes == [each for each in keyframes[before:] if not each.is_culled]
    assert made.slam.map.own_keyframes == made.slam.map.active_keyframes
    assert [view.keyframe for view in second.views] == keyframes
    # A third run is localised in the part that the second run added.
    save_map(tmp_path / "grown.map", second.slam.mapper.map, second.views)
    end = Slide(1200, 1270, step=10)
    third = run(end, LOCALISE, load_map(tmp_path / "grown.map", CAMERA, LOCALISE))
    assert third.slam.poses.statuses == [TrackingStatus.TRACKED] * len(end)
    assert position_errors(third, end).max() < 0.03


@pytest.mark.parametrize("config", [CONFIG, LOCALISE])
def test_run_that_starts_outside_of_the_map_is_corrected_on_relocalisation(
    config: Config, wall: tuple[Path, Pipeline]
) -> None:
    path, _ = wall
    into = Slide(100, 760, step=15)
    second = run(into, config, load_map(path, CAMERA, config))
    statuses = second.slam.poses.statuses
    found = statuses.index(TrackingStatus.TRACKED)
    assert 10 < found < 35
    assert statuses == [TrackingStatus.ODOMETRY] * found + [TrackingStatus.TRACKED] * (len(into) - found)
    error = position_errors(second, into)
    assert error[-10:].max() < 0.01
    assert error.max() < 0.1  # over 3 m of the wall, by odometry


def test_lost_camera_accumulates_no_rotation_from_a_wrong_readout(wall: tuple[Path, Pipeline]) -> None:
    """At constant velocity all images are distorted alike, so that relative motions are right despite the readout."""
    path, _ = wall
    rolling = replace(CAMERA, readout=0.02)
    known = load_map(path, rolling, LOCALISE).map
    known.readout = Readout(0.02, math.inf)
    slam = V3DSLAM(rolling, NoSegmentation(), LOCALISE, known)
    into = Slide(100, 760, step=15)
    for index in range(len(into)):
        slam(into[index])
    T_wc = slam.poses.trajectory().T_wc
    rotation = se3_log(invert(T_wc[2]) @ T_wc[slam.poses.statuses.index(TrackingStatus.TRACKED) - 1])[3:]
    assert rotation.norm() < 0.02  # 0.1 without a velocity while the camera is lost


def test_frames_before_a_gap_in_the_odometry_stay_lost(wall: tuple[Path, Pipeline]) -> None:
    path, _ = wall
    into = Slide(100, 700, step=15, dark=(8,))
    second = run(into, LOCALISE, load_map(path, CAMERA, LOCALISE))
    statuses = second.slam.poses.statuses
    found = statuses.index(TrackingStatus.TRACKED)
    assert statuses[:found] == 9 * [TrackingStatus.LOST] + (found - 9) * [TrackingStatus.ODOMETRY]
    error = position_errors(second, into)
    assert error[9:].max() < 0.1
    assert error[:9].max() < 0.5  # predicted from the motion before


def test_camera_in_another_room_stays_lost_and_leaves_the_map_unchanged(
    wall: tuple[Path, Pipeline], tmp_path: Path
) -> None:
    path, _ = wall
    elsewhere = Slide(640, 960, step=16, seed=5)
    second = run(elsewhere, CONFIG, load_map(path, CAMERA, CONFIG))
    assert second.slam.poses.statuses == [TrackingStatus.LOST] * len(elsewhere)
    assert not second.slam.poses.was_found
    save_map(tmp_path / "after.map", second.slam.mapper.map, second.views)
    assert (tmp_path / "after.map").read_bytes() == path.read_bytes()


def test_segmenter_gets_no_pose_before_relocalisation(wall: tuple[Path, Pipeline]) -> None:
    path, _ = wall
    has_pose: list[bool] = []

    class PoseRecorder(NoSegmentation):
        def segment_with_pose(self, frame: RGBDFrame, T_cw: Tensor | None) -> Instances:
            has_pose.append(T_cw is not None)
            return self(frame)

    slam = V3DSLAM(CAMERA, PoseRecorder(), LOCALISE, load_map(path, CAMERA, LOCALISE).map)
    for frame in Slide(400, 660, step=20):
        slam(frame)
    found = slam.poses.statuses.index(TrackingStatus.TRACKED)
    # The next frames are preprocessed before this frame is tracked.
    unknown = found + 1 + PREFETCHED_FRAMES
    assert has_pose == unknown * [False] + (len(has_pose) - unknown) * [True] and has_pose[-1]


def test_map_that_was_loaded_with_another_configuration_is_rejected(wall: tuple[Path, Pipeline]) -> None:
    """The system changed a map that it only localises in."""
    known = load_map(wall[0], CAMERA, CONFIG).map
    with pytest.raises(ConfigError, match=r"^the known map was loaded with other values in the sections mapping or"):
        V3DSLAM(CAMERA, NoSegmentation(), LOCALISE, known)
