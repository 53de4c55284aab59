"""The rolling shutter: where features would have been seen had all rows been read at once; how long reading takes."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.features.orb import Features
from v3d_torch.geometry.camera import MAX_READOUT, PinholeCamera
from v3d_torch.geometry.se3 import invert, se3_exp, se3_log
from v3d_torch.mapping.readout_calibration import calibrate_readout
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.odometry.rolling_shutter import GLOBAL_SHUTTER, Readout, RollingShutterCompensation
from v3d_torch.tracking.camera_tracker import CameraTracker
from v3d_torch.tracking.map_tracker import MapTracker
from v3d_torch.tracking.pose_history import PoseHistory
from v3d_torch.types import FramePose, TrackingStatus

CAMERA = PinholeCamera(525.0, 520.0, 320.0, 240.0)
KINECT = Readout(0.026, 1e8)
SHAKE = torch.tensor([0.4, -0.3, 0.2, 0.9, -1.1, 1.3], dtype=torch.float64)  # m/s and rad/s
STILL = torch.zeros(6, dtype=torch.float64)
EYE = torch.eye(4, dtype=torch.float64)
_NO_PLACES: Any = None  # the pose of a frame that was found asks for none


def cloud(count: int = 200) -> Tensor:
    """Points that the camera sees, metres, (N, 3)."""
    generator = torch.Generator().manual_seed(3)
    u, v, z = torch.rand(3, count, generator=generator, dtype=torch.float64)
    return CAMERA.back_project(torch.stack([40 + 560 * u, 40 + 400 * v], dim=1), 1 + 3 * z)


def features_of(uv: Tensor, depth: Tensor) -> Features:
    number = torch.zeros(len(uv), dtype=torch.int64)
    return Features(uv, uv.round().long(), depth, number, torch.zeros(len(uv), 32, dtype=torch.uint8))


def rolled(points: Tensor, velocity: Tensor, readout: float) -> Features:
    """Points as a camera in motion reads them: each where it is when its row is read."""
    seen = points
    for _ in range(20):  # which row that is depends on where it is seen
        late = (CAMERA.project(seen)[:, 1].round() / (CAMERA.height - 1) - 0.5) * readout
        moved = se3_exp(late[:, None] * velocity)
        seen = (moved[:, :3, :3] @ points[..., None])[..., 0] + moved[:, :3, 3]
    return features_of(CAMERA.project(seen), points[:, 2])


def error(velocity: Tensor, readout: Readout) -> float:
    """Greatest distance from where the points are seen at the time of the middle row, pixels."""
    read = rolled(cloud(), velocity, KINECT.seconds)
    put = RollingShutterCompensation(CAMERA)(read, velocity, readout)
    return float((put.uv - CAMERA.project(cloud())).norm(dim=1).max())


def test_features_are_put_where_the_middle_row_would_have_seen_them() -> None:
    assert error(SHAKE, Readout(0.0, 1.0)) > 10
    assert error(SHAKE, KINECT) < 0.1


def test_the_drift_is_the_derivative_by_the_readout() -> None:
    read = rolled(cloud(), SHAKE, KINECT.seconds)
    less, more = (RollingShutterCompensation(CAMERA)(read, SHAKE, Readout(seconds, 1.0)) for seconds in (0.010, 0.020))
    torch.testing.assert_close((more.uv - less.uv) / 0.010, less.readout_jacobian, rtol=1e-9, atol=1e-6)


def test_an_infinitely_far_point_drifts_by_the_rotation_alone() -> None:
    uv = CAMERA.project(cloud())
    far, nothing = features_of(uv, torch.full((len(uv),), 1e9).double()), features_of(uv, torch.zeros(len(uv)).double())
    unroll = RollingShutterCompensation(CAMERA)
    torch.testing.assert_close(unroll(nothing, SHAKE, KINECT).uv, unroll(far, SHAKE, KINECT).uv, rtol=0, atol=1e-6)


def test_another_velocity_takes_the_place_of_the_first() -> None:
    read, unroll = rolled(cloud(), SHAKE, KINECT.seconds), RollingShutterCompensation(CAMERA)
    twice = unroll(unroll(read, -2 * SHAKE, KINECT), SHAKE, KINECT)
    torch.testing.assert_close(twice.uv, unroll(read, SHAKE, KINECT).uv, rtol=0, atol=1e-9)
    torch.testing.assert_close(unroll(twice, STILL, KINECT).uv, read.uv, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("velocity", "readout"), [(STILL, KINECT), (SHAKE, GLOBAL_SHUTTER)])
def test_without_motion_or_with_a_global_shutter_nothing_moves(velocity: Tensor, readout: Readout) -> None:
    read = rolled(cloud(), SHAKE, KINECT.seconds)
    assert torch.equal(RollingShutterCompensation(CAMERA)(read, velocity, readout).uv, read.uv)


def test_of_no_features_there_are_none() -> None:
    read = rolled(cloud(), SHAKE, KINECT.seconds)[torch.zeros(0, dtype=torch.int64)]
    assert len(RollingShutterCompensation(CAMERA)(read, SHAKE, KINECT)) == 0


# --- how long reading takes


@settings(deadline=None, max_examples=50)
@given(st.floats(0, 0.03), st.floats(0, 0.03), st.floats(1e3, 1e8), st.floats(1e3, 1e8))
def test_of_gaussian_costs_the_mean_by_information_is_learnt(a: float, b: float, known: float, told: float) -> None:
    learnt = calibrate_readout(Readout(a, known), slope=2 * told * (a - b), curvature=2 * told)
    assert learnt.information == pytest.approx(0.8 * known + 0.1 * told, rel=1e-12)
    assert learnt.seconds == pytest.approx((0.8 * known * a + 0.1 * told * b) / learnt.information, abs=1e-9)


@pytest.mark.parametrize("curvature", [0.0, -1e6])
def test_costs_without_a_bottom_teach_nothing(curvature: float) -> None:
    assert calibrate_readout(KINECT, slope=5.0, curvature=curvature) == KINECT


def test_a_camera_that_is_known_for_sure_learns_nothing() -> None:
    assert calibrate_readout(GLOBAL_SHUTTER, slope=5.0, curvature=1e6) == GLOBAL_SHUTTER


def test_what_the_camera_says_of_itself_is_sure_and_else_something_is_expected() -> None:
    expected = Config().rolling_shutter
    assert Readout.from_camera(CAMERA, expected) == Readout(expected.readout, expected.readout_sigma**-2)
    assert Readout.from_camera(replace(CAMERA, readout=0.0), expected) == GLOBAL_SHUTTER
    assert calibrate_readout(Readout.from_camera(replace(CAMERA, readout=0.025), expected), 5.0, 1e6).seconds == 0.025


def test_no_camera_takes_longer_than_it_can() -> None:
    learnt = calibrate_readout(Readout(0.01, 1.0), slope=-2e6 * 2.99, curvature=2e6)
    assert learnt.seconds == pytest.approx(MAX_READOUT, abs=1e-6)


@pytest.mark.parametrize("about", [{"seconds": 0.1, "information": 1.0}, {"seconds": math.nan, "information": 1.0}])
def test_what_no_camera_can_be_is_refused(about: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="readout"):
        Readout.from_dict(about)


# --- in the map


def mapped(readout: Readout) -> SparseMap:
    """Two keyframes that saw the same points while the camera moved."""
    config = Config()
    sparse_map = SparseMap(config.mapping, config.features, CAMERA)
    sparse_map.readout = readout
    seen = RollingShutterCompensation(CAMERA)(rolled(cloud(), SHAKE, KINECT.seconds), SHAKE, readout)
    first = sparse_map.insert_keyframe(0, 0.0, torch.eye(4, dtype=torch.float64), seen, torch.full((len(seen),), -1))
    sparse_map.insert_keyframe(1, 0.1, torch.eye(4, dtype=torch.float64), seen, first.landmarks)
    return sparse_map


def test_another_readout_moves_all_that_was_seen() -> None:
    learnt, known = mapped(Readout(0.010, 1.0)), mapped(KINECT)
    learnt.set_readout(KINECT)
    assert learnt.readout == KINECT
    torch.testing.assert_close(learnt.observations["uv"], known.observations["uv"], rtol=0, atol=1e-9)
    for ours, theirs in zip(learnt.keyframes, known.keyframes, strict=True):
        torch.testing.assert_close(ours.features.uv, theirs.features.uv, rtol=0, atol=1e-9)


def test_a_keyframe_whose_motion_is_known_better_is_seen_again() -> None:
    sparse_map = mapped(KINECT)
    newest, others = sparse_map.keyframes[1], sparse_map.observations["keyframe"] == 0
    before = sparse_map.observations["uv"].clone()
    sparse_map.update_features(newest, RollingShutterCompensation(CAMERA)(newest.features, SHAKE / 2, KINECT))
    assert torch.equal(sparse_map.observations["uv"][others], before[others])
    feature = sparse_map.observations["feature"][~others]
    assert torch.equal(sparse_map.observations["uv"][~others], newest.features.uv[feature])
    assert torch.equal(sparse_map.observations["readout_jacobian"][~others], newest.features.readout_jacobian[feature])
    assert not torch.equal(sparse_map.observations["uv"][~others], before[~others])


def test_a_frame_is_put_where_the_motion_says_that_is_known_later() -> None:
    """Between keyframes, which bundle adjustment sees again, nothing else would put a pose right."""
    config, T_cw = Config(), se3_exp(0.1 * SHAKE)
    sparse_map = SparseMap(config.mapping, config.features, CAMERA)
    first = sparse_map.insert_keyframe(
        0, 0.0, EYE, features_of(CAMERA.project(cloud()), cloud()[:, 2]), torch.full((200,), -1)
    )
    read = rolled(cloud() @ T_cw[:3, :3].T + T_cw[:3, 3], SHAKE, KINECT.seconds)
    localise = CameraTracker(MapTracker(config.tracking, config.features, CAMERA), _NO_PLACES, sparse_map, 15)

    poses = PoseHistory()
    poses.record(0.0, FramePose(TrackingStatus.TRACKED, T_cw, first.landmarks), first)
    poses.record(0.1, FramePose(TrackingStatus.TRACKED, se3_exp(0.2 * SHAKE), first.landmarks), first)
    errors, after = [], poses.T_cw
    for known in (STILL, SHAKE / 2, SHAKE):
        found, points = sparse_map.landmark_positions(first.landmarks)
        localise.again(RollingShutterCompensation(CAMERA)(read[found], known, KINECT), points, poses)
        errors.append(float(se3_log(poses.T_pw @ invert(T_cw)).norm()))
    assert errors[0] > 1.5 * errors[1] > 15 * errors[2]
    assert torch.equal(poses.T_cw, after)  # the pose of the frame after stays

    few = slice(0, config.tracking.min_inliers - 1)
    before = poses.T_pw
    localise.again(read[torch.arange(200)[few]], points[few], poses)
    assert torch.equal(poses.T_pw, before)


def test_only_landmarks_that_live_are_behind_features() -> None:
    sparse_map = mapped(KINECT)
    first = sparse_map.keyframes[0]
    shown = torch.where(torch.arange(len(first.landmarks)) % 2 == 0, first.landmarks, -1)
    sparse_map.landmarks["active"][shown[4]] = False
    found, points = sparse_map.landmark_positions(shown)
    assert found.tolist() == [i for i in range(0, len(shown), 2) if i != 4]
    assert torch.equal(points, sparse_map.landmarks["point"][first.landmarks[found]])


def test_features_keep_their_drift_when_some_are_chosen() -> None:
    seen = RollingShutterCompensation(CAMERA)(rolled(cloud(), SHAKE, KINECT.seconds), SHAKE, KINECT)
    assert torch.equal(seen[torch.tensor([3, 1])].readout_jacobian, seen.readout_jacobian[[3, 1]])
    assert torch.equal(
        rolled(cloud(), SHAKE, KINECT.seconds).readout_jacobian, torch.zeros_like(seen.uv)
    )  # which was not given
