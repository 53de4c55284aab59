"""Refinement of the previous frame with the velocity from the poses before and after it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.rolling_camera import AT_REST, CAMERA, observe_rolling
from helpers.sparse_maps import EYE, features
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.features.features import Features
from v3d_torch.geometry.se3 import invert, se3_exp, se3_log
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.odometry.odometry import CameraMotion, TrackedFrame
from v3d_torch.odometry.rolling_shutter import Readout
from v3d_torch.odometry.time_compensation import TimeCompensation
from v3d_torch.tracking.map_tracker import MapTracker
from v3d_torch.tracking.pose_history import PoseHistory
from v3d_torch.tracking.previous_frame import PreviousFrameRefinement
from v3d_torch.types import FramePose, RGBDFrame, TrackingStatus

COUNT = 400
READOUT = 0.03
VELOCITY = torch.tensor([0.4, -0.2, 0.1, 0.1, 0.3, -0.2], dtype=torch.float64)
"""Twist of the camera around the previous frame, m/s and rad/s."""
MOTION = se3_exp(torch.tensor([0.03, -0.02, 0.01, 0.01, -0.02, 0.02], dtype=torch.float64))
"""True pose ``T_cw`` of the previous frame."""
NO_PAIRS = torch.zeros(0, 2, dtype=torch.int64)


class Scene:
    """Map of one keyframe at the origin, and a later frame of a moving rolling-shutter camera that is tracked in it."""

    def __init__(self) -> None:
        self.config = Config()
        self.map = SparseMap(self.config.mapping, self.config.features, CAMERA)
        self.map.readout = replace(self.map.readout, seconds=READOUT)
        self.compensate = TimeCompensation(self.config, CAMERA)
        first = self.map.insert_keyframe(0, 0.0, EYE, features(COUNT), torch.full((COUNT,), -1))
        in_camera = self.map.landmarks["point"][first.landmarks] @ MOTION[:3, :3].T + MOTION[:3, 3]
        uv = CAMERA.project(in_camera)
        inside = ((uv >= 1) & (uv < torch.tensor([639, 479]))).all(dim=1)
        self.ids, self.uv = first.landmarks[inside], uv[inside]
        observed = observe_rolling(in_camera[inside], VELOCITY, READOUT)
        observed = replace(observed, octave=first.features.octave[inside])
        depth = torch.ones(1, 480, 640)
        frame = RGBDFrame(1, 0.1, torch.zeros(3, 480, 640, dtype=torch.uint8), depth)
        self.previous = TrackedFrame(frame, depth, observed, torch.ones(480, 640).bool(), self.ids)
        motion = CameraMotion(EYE, VELOCITY, NO_PAIRS, is_measured=True)
        self.poses = PoseHistory()
        self.poses.append(0.0, FramePose(TrackingStatus.TRACKED, EYE, first.landmarks), motion, first, None)
        self.poses.append(0.1, FramePose(TrackingStatus.TRACKED, self.pose_of(observed), self.ids), motion, first, None)

    def track_map(self) -> MapTracker:
        return MapTracker(self.config.tracking, self.config.features, CAMERA)

    def pose_of(self, observed: Features) -> Tensor:
        """Pose refined from observed features, without compensation."""
        refined = self.track_map().refine(EYE, self.map.landmarks["point"][self.ids], observed, rounds=4)
        assert refined is not None
        return refined.T_cw

    def refine(
        self, previous: TrackedFrame | None, velocity: Tensor | None = VELOCITY, *, refine_pose: bool = True
    ) -> None:
        refine = PreviousFrameRefinement(self.track_map(), self.map, refine_pose=refine_pose)
        refine(previous, velocity, self.poses, self.compensate)

    def pose_error(self) -> float:
        """Error of the last pose, metres and radians."""
        return float(se3_log(self.poses.T_cw @ invert(MOTION)).norm())


def test_pose_is_refined_with_the_velocity_of_both_sides() -> None:
    scene = Scene()
    before, first_pose = scene.pose_error(), scene.poses.trajectory().T_wc[0]
    scene.refine(scene.previous)
    assert before > 2e-3
    assert scene.pose_error() < 0.1 * before
    assert torch.equal(scene.poses.trajectory().T_wc[0], first_pose)  # only the last frame is changed
    assert scene.poses.statuses == 2 * [TrackingStatus.TRACKED]


def test_frame_with_the_index_of_the_newest_keyframe_is_not_that_keyframe() -> None:
    """A camera that is started again counts from 0 again, and a user's loop may not count at all."""
    scene = Scene()
    before, keyframe = scene.pose_error(), scene.map.keyframes[-1]
    features_before = keyframe.features
    scene.refine(replace(scene.previous, frame=replace(scene.previous.frame, index=keyframe.frame)))
    assert scene.pose_error() < 0.1 * before
    assert keyframe.features is features_before


def test_pose_is_more_accurate_with_a_better_velocity() -> None:
    """Bundle adjustment corrects keyframes; the poses between them are corrected here only."""
    scene = Scene()
    errors = []
    for velocity in (AT_REST, VELOCITY / 2, VELOCITY):
        scene.refine(scene.previous, velocity)
        errors.append(scene.pose_error())
    assert errors[0] > 1.5 * errors[1] > 15 * errors[2]


def test_refinement_tolerates_some_wrong_landmarks() -> None:
    scene = Scene()
    before, ids = scene.pose_error(), scene.ids.clone()
    ids[:40] = ids[:40].flip(0)
    scene.refine(replace(scene.previous, landmarks=ids))
    assert scene.pose_error() < 0.3 * before


def test_features_without_an_active_landmark_are_not_used() -> None:
    scene = Scene()
    ids, wrong = scene.ids.clone(), scene.ids[:150]
    scene.map.landmarks["active"][wrong[:75]] = False
    scene.map.landmarks["point"][wrong] += 5.0
    ids[75:150] = -1
    before = scene.pose_error()
    scene.refine(replace(scene.previous, landmarks=ids))
    assert scene.pose_error() < 0.1 * before


def test_features_of_the_newest_keyframe_are_compensated_again_in_the_map() -> None:
    scene = Scene()
    T_cw = scene.poses.T_cw
    keyframe = scene.map.insert_keyframe(1, 0.1, T_cw, scene.previous.features, scene.ids)
    motion = CameraMotion(EYE, VELOCITY, NO_PAIRS, is_measured=True)
    scene.poses.append(0.1, FramePose(TrackingStatus.TRACKED, T_cw, scene.ids), motion, keyframe, keyframe)
    scene.refine(scene.previous)
    torch.testing.assert_close(keyframe.features.uv, scene.uv, rtol=0, atol=0.05)
    assert (keyframe.features.uv - scene.previous.features.uv).norm(dim=1).median() > 1
    rows = scene.map.observations["keyframe"] == keyframe.index
    observed = scene.map.observations["uv"][rows]
    assert torch.equal(observed, keyframe.features.uv[scene.map.observations["feature"][rows]])
    assert torch.equal(keyframe.T_cw, T_cw) and torch.equal(scene.poses.T_cw, T_cw)  # left to the bundle adjustment


def test_keyframe_without_a_measured_motion_is_refined_with_the_landmarks_that_it_creates() -> None:
    """The first frame after a gap is tracked without a velocity, and the next frames with its landmarks."""
    scene, known = Scene(), 150
    T_cw, before = scene.poses.T_cw, scene.pose_error()
    matched = torch.where(torch.arange(len(scene.ids)) < known, scene.ids, -1)
    keyframe = scene.map.insert_keyframe(1, 0.1, T_cw, scene.previous.features, matched)
    motion = CameraMotion(EYE, torch.zeros_like(VELOCITY), NO_PAIRS, is_measured=False)
    scene.poses.append(0.1, FramePose(TrackingStatus.TRACKED, T_cw, scene.ids[:known]), motion, keyframe, keyframe)
    old = scene.map.landmarks["point"][scene.ids].clone()
    created = (keyframe.landmarks >= 0) & (matched < 0)
    wrong = scene.map.landmarks["point"][keyframe.landmarks[created]] - old[created]
    scene.refine(scene.previous)
    error = scene.map.landmarks["point"][keyframe.landmarks[created]] - old[created]
    assert created.sum() > 50
    assert scene.pose_error() < 0.1 * before
    assert error.norm(dim=1).median() < 0.1 * wrong.norm(dim=1).median()
    assert torch.equal(scene.map.landmarks["point"][scene.ids], old)  # they were created by the first keyframe


def test_keyframe_without_a_measured_motion_keeps_its_pose_without_refinement_of_poses() -> None:
    scene = Scene()
    T_cw = scene.poses.T_cw
    keyframe = scene.map.insert_keyframe(1, 0.1, T_cw, scene.previous.features, scene.ids)
    motion = CameraMotion(EYE, torch.zeros_like(VELOCITY), NO_PAIRS, is_measured=False)
    scene.poses.append(0.1, FramePose(TrackingStatus.TRACKED, T_cw, scene.ids), motion, keyframe, keyframe)
    scene.refine(scene.previous, refine_pose=False)
    assert torch.equal(keyframe.T_cw, T_cw)


def test_depth_of_the_newest_keyframe_is_compensated_again_by_its_delay() -> None:
    scene, delay = Scene(), 0.02
    keyframe = scene.map.insert_keyframe(1, 0.1, scene.poses.T_cw, scene.previous.features, scene.ids)
    observed, depth = keyframe.features, scene.previous.depth
    scene.refine(replace(scene.previous, frame=replace(scene.previous.frame, depth_delay=delay)))
    expected, undelayed = (
        scene.compensate(observed, depth, each, VELOCITY, scene.map.readout) for each in (delay, 0.0)
    )
    torch.testing.assert_close(keyframe.features.depth, expected.depth)
    assert not torch.equal(expected.depth, undelayed.depth)


def test_pose_stays_without_refinement_of_poses() -> None:
    scene = Scene()
    T_cw = scene.poses.T_cw
    scene.refine(scene.previous, refine_pose=False)
    assert torch.equal(scene.poses.T_cw, T_cw)


def test_pose_stays_with_too_few_landmarks() -> None:
    scene = Scene()
    T_cw, ids = scene.poses.T_cw, scene.ids.clone()
    ids[scene.config.tracking.min_inliers - 1 :] = -1
    scene.refine(replace(scene.previous, landmarks=ids))
    assert torch.equal(scene.poses.T_cw, T_cw)


@pytest.mark.parametrize("unknown", ["previous frame", "landmarks", "velocity", "map"])
def test_nothing_changes_while_anything_is_unknown(unknown: str) -> None:
    scene = Scene()
    T_wc, uv = scene.poses.trajectory().T_wc, scene.map.observations["uv"].clone()
    previous: TrackedFrame | None = scene.previous
    if unknown == "previous frame":
        previous = None
    elif unknown == "landmarks":
        previous = replace(scene.previous, landmarks=None)
    elif unknown == "map":
        scene.map = SparseMap(scene.config.mapping, scene.config.features, CAMERA)
    scene.refine(previous, None if unknown == "velocity" else VELOCITY)
    assert torch.equal(scene.poses.trajectory().T_wc, T_wc)
    assert unknown == "map" or torch.equal(scene.map.observations["uv"], uv)


def test_readout_of_zero_leaves_features_as_observed() -> None:
    scene = Scene()
    scene.map.readout = Readout(0.0, scene.map.readout.information)
    points = scene.map.landmarks["point"][scene.ids]
    expected = scene.track_map().refine(scene.poses.T_cw, points, scene.previous.features, rounds=1)
    scene.refine(scene.previous)
    assert expected is not None
    torch.testing.assert_close(scene.poses.T_cw, expected.T_cw, rtol=0, atol=1e-12)
