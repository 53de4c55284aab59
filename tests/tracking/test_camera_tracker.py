"""Tracking of the camera: source of the pose, and whether the camera was found again."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from helpers.moving_camera import EYE, Camera, frame_pose
from helpers.sparse_maps import features, make_map
from torch import Tensor

from v3d_torch.odometry.odometry import CameraMotion
from v3d_torch.tracking.camera_tracker import CameraTracker
from v3d_torch.tracking.map_tracker import MapTracking
from v3d_torch.types import FramePose, TrackingStatus

TRACKED, ODOMETRY, LOST = TrackingStatus.TRACKED, TrackingStatus.ODOMETRY, TrackingStatus.LOST


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
    camera.append(0.0, frame_pose(EYE, previous), keyframe)
    motion = CameraMotion(EYE, torch.zeros(6, dtype=torch.float64), torch.zeros(0, 2, dtype=torch.int64), True)
    tracker = CameraTracker(track_map, SimpleNamespace(relocalise=relocalise), sparse_map, 5)  # type: ignore[arg-type]
    depth: Tensor = torch.zeros(1, 480, 640)
    return tracker(features(20), depth, EYE, unmatched, motion, camera.poses)


@pytest.mark.parametrize("previous", [TRACKED, ODOMETRY, LOST])
def test_camera_is_relocalised_if_its_pose_does_not_continue_one_in_the_map(previous: TrackingStatus) -> None:
    tracked = track(previous, in_local_map=True, at_known_place=False)
    assert tracked.status is TRACKED and tracked.is_relocalised is (previous is not TRACKED)
    found = track(previous, in_local_map=False, at_known_place=True)
    assert found.status is TRACKED and found.is_relocalised
    missed = track(previous, in_local_map=False, at_known_place=False)
    assert missed.status is (LOST if previous is LOST else ODOMETRY) and not missed.is_relocalised
