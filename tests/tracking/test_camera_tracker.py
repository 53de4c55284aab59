"""Tracking of the camera: source of the pose, and whether the camera was found again."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from helpers.moving_camera import EYE, TWIST, Camera, frame_pose
from helpers.sparse_maps import features, make_map
from torch import Tensor

from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.odometry.odometry import CameraMotion
from v3d_torch.tracking.camera_tracker import CameraTracker
from v3d_torch.tracking.map_tracker import MapTracking
from v3d_torch.types import FramePose, TrackingStatus

TRACKED, DISCONNECTED = TrackingStatus.TRACKED, TrackingStatus.DISCONNECTED
ODOMETRY, LOST = TrackingStatus.ODOMETRY, TrackingStatus.LOST


def track(previous: TrackingStatus, *, in_local_map: bool, at_known_place: bool) -> FramePose:
    """Track a frame after a frame of a status, with measured motion, in a map with one keyframe."""
    sparse_map, unmatched = make_map(), torch.full((20,), -1)
    keyframe = sparse_map.insert_keyframe(0, 0.0, EYE, features(20), unmatched)
    found = MapTracking(EYE, keyframe.landmarks, keyframe.landmarks, torch.eye(6, dtype=torch.float64))

    def track_map(*args: Any) -> MapTracking | None:
        return found if in_local_map else None

    def relocalise(*args: Any) -> SimpleNamespace | None:
        return SimpleNamespace(tracking=found) if at_known_place else None

    camera = Camera()
    if previous is DISCONNECTED:
        keyframe.part = sparse_map.unused_part
    camera.append(0.0, frame_pose(EYE, TRACKED if previous is DISCONNECTED else previous), keyframe)
    assert camera.poses.status is previous
    motion = CameraMotion(EYE, torch.zeros(6, dtype=torch.float64), torch.zeros(0, 2, dtype=torch.int64), True)
    tracker = CameraTracker(track_map, SimpleNamespace(relocalise=relocalise), sparse_map, 5)  # type: ignore[arg-type]
    depth: Tensor = torch.zeros(1, 480, 640)
    return tracker(features(20), depth, EYE, unmatched, motion, camera.poses)


@pytest.mark.parametrize("previous", [TRACKED, DISCONNECTED, ODOMETRY, LOST])
def test_camera_is_relocalised_if_its_pose_does_not_continue_one_in_the_map(previous: TrackingStatus) -> None:
    tracked = track(previous, in_local_map=True, at_known_place=False)
    assert tracked.status is TRACKED and tracked.is_relocalised is (previous in (ODOMETRY, LOST))
    found = track(previous, in_local_map=False, at_known_place=True)
    assert found.status is TRACKED and found.is_relocalised
    missed = track(previous, in_local_map=False, at_known_place=False)
    assert missed.status is (LOST if previous in (DISCONNECTED, LOST) else ODOMETRY) and not missed.is_relocalised


def test_tracked_frame_counts_which_landmarks_it_found_of_those_in_view() -> None:
    """Landmarks that few frames find are culled."""
    sparse_map, unmatched = make_map(), torch.full((20,), -1)
    keyframe = sparse_map.insert_keyframe(0, 0.0, EYE, features(20), unmatched)
    found = MapTracking(EYE, keyframe.landmarks.where(torch.arange(20) < 5, -1), keyframe.landmarks, EYE)
    tracker = CameraTracker(lambda *args: found, SimpleNamespace(relocalise=None), sparse_map, 5)  # type: ignore[arg-type]
    motion = CameraMotion(EYE, torch.zeros(6, dtype=torch.float64), torch.zeros(0, 2, dtype=torch.int64), True)
    tracker(features(20), torch.zeros(1, 480, 640), EYE, unmatched, motion, Camera().poses)
    assert sparse_map.landmarks["found"].tolist() == [2] * 5 + [1] * 15
    assert sparse_map.landmarks["visible"].tolist() == [2] * 20


def test_frame_without_landmarks_does_not_move_with_another_part_of_the_map() -> None:
    """A camera that started part 1 is found again in part 0; then tracking fails, and a loop moves part 1."""
    sparse_map, unmatched = make_map(), torch.full((20,), -1)
    first = sparse_map.insert_keyframe(0, 0.0, EYE, features(20), unmatched)
    second = sparse_map.insert_keyframe(1, 0.1, EYE, features(20, seed=1), unmatched)
    second.part = sparse_map.unused_part
    camera, track_nothing = Camera(), SimpleNamespace(relocalise=lambda *args: None)
    tracker = CameraTracker(lambda *args: None, track_nothing, sparse_map, 5)
    camera.append(0.0, frame_pose(EYE, LOST), None, new=first)
    camera.append(0.1, frame_pose(EYE, LOST), first, new=second)
    found = FramePose(TRACKED, EYE, first.landmarks)
    camera.append(0.2, found, tracker.reference_keyframe(found, camera.poses), EYE)
    motion = CameraMotion(EYE, torch.zeros(6, dtype=torch.float64), torch.zeros(0, 2, dtype=torch.int64), True)
    missed = tracker(features(20), torch.zeros(1, 480, 640), EYE, unmatched, motion, camera.poses)
    assert missed.status is ODOMETRY
    camera.append(0.3, missed, tracker.reference_keyframe(missed, camera.poses), EYE)
    sparse_map.move_keyframes(torch.stack([EYE, se3_exp(TWIST)]))
    assert camera.poses.is_localised and torch.equal(camera.poses.T_cw, EYE)


def test_reference_keyframe_of_a_first_frame_without_landmarks_is_the_last_keyframe() -> None:
    sparse_map, unmatched, poses = make_map(), torch.full((20,), -1), Camera().poses
    tracker = CameraTracker(lambda *args: None, SimpleNamespace(relocalise=lambda *args: None), sparse_map, 5)
    assert tracker.reference_keyframe(frame_pose(EYE, LOST), poses) is None
    for index in range(2):
        sparse_map.insert_keyframe(index, 0.1 * index, EYE, features(20, seed=index), unmatched)
    assert tracker.reference_keyframe(frame_pose(EYE, LOST), poses) is sparse_map.keyframes[-1]
