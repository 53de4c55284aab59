"""Rolling-shutter compensation, calibration of the readout, and both in the map and in tracking."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.features.features import Features
from v3d_torch.geometry.camera import MAX_READOUT, PinholeCamera
from v3d_torch.geometry.se3 import invert, se3_exp, se3_log
from v3d_torch.mapping.readout_calibration import calibrate_readout
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.odometry.odometry import CameraMotion, TrackedFrame
from v3d_torch.odometry.rolling_shutter import GLOBAL_SHUTTER, Readout, RollingShutterCompensation
from v3d_torch.odometry.time_compensation import TimeCompensation
from v3d_torch.tracking.map_tracker import MapTracker
from v3d_torch.tracking.pose_history import PoseHistory
from v3d_torch.tracking.previous_frame import PreviousFrameRefinement
from v3d_torch.types import FramePose, RGBDFrame, TrackingStatus

CAMERA = PinholeCamera(525.0, 520.0, 320.0, 240.0)
KINECT = Readout(0.026, 1e8)
VELOCITY = torch.tensor([0.4, -0.3, 0.2, 0.9, -1.1, 1.3], dtype=torch.float64)  # m/s and rad/s
AT_REST = torch.zeros(6, dtype=torch.float64)
EYE = torch.eye(4, dtype=torch.float64)


def points_in_view(count: int = 200) -> Tensor:
    """Points in the camera's field of view, camera frame, metres, (N, 3)."""
    generator = torch.Generator().manual_seed(3)
    u, v, z = torch.rand(3, count, generator=generator, dtype=torch.float64)
    return CAMERA.back_project(torch.stack([40 + 560 * u, 40 + 400 * v], dim=1), 1 + 3 * z)


def features_of(uv: Tensor, depth: Tensor) -> Features:
    octave = torch.zeros(len(uv), dtype=torch.int64)
    return Features(uv, uv.round().long(), depth, octave, torch.zeros(len(uv), 32, dtype=torch.uint8))


def observe_rolling(points: Tensor, velocity: Tensor, readout: float) -> Features:
    """Features of points observed by a moving rolling-shutter camera, each at the time of its row."""
    moved = points
    for _ in range(20):  # fixed-point iteration: the row of a point depends on where it is observed
        delay = (CAMERA.project(moved)[:, 1].round() / (CAMERA.height - 1) - 0.5) * readout
        T = se3_exp(delay[:, None] * velocity)
        moved = (T[:, :3, :3] @ points[..., None])[..., 0] + T[:, :3, 3]
    return features_of(CAMERA.project(moved), points[:, 2])


def max_error(velocity: Tensor, readout: Readout) -> float:
    """Largest distance of compensated features to the projections at the time of the middle row, pixels."""
    observed = observe_rolling(points_in_view(), velocity, KINECT.seconds)
    compensated = RollingShutterCompensation(CAMERA)(observed, velocity, readout)
    return float((compensated.uv - CAMERA.project(points_in_view())).norm(dim=1).max())


def test_compensation_moves_features_to_the_time_of_the_middle_row() -> None:
    assert max_error(VELOCITY, Readout(0.0, 1.0)) > 10
    assert max_error(VELOCITY, KINECT) < 0.1


def test_readout_jacobian_is_the_derivative_by_the_readout() -> None:
    observed = observe_rolling(points_in_view(), VELOCITY, KINECT.seconds)
    shorter, longer = (
        RollingShutterCompensation(CAMERA)(observed, VELOCITY, Readout(seconds, 1.0)) for seconds in (0.010, 0.020)
    )
    torch.testing.assert_close((longer.uv - shorter.uv) / 0.010, shorter.readout_jacobian, rtol=1e-9, atol=1e-6)


def test_features_without_depth_are_compensated_as_infinitely_far() -> None:
    uv = CAMERA.project(points_in_view())
    far = features_of(uv, torch.full((len(uv),), 1e9).double())
    without_depth = features_of(uv, torch.zeros(len(uv)).double())
    compensate = RollingShutterCompensation(CAMERA)
    torch.testing.assert_close(
        compensate(without_depth, VELOCITY, KINECT).uv, compensate(far, VELOCITY, KINECT).uv, rtol=0, atol=1e-6
    )


def test_compensation_with_another_velocity_replaces_the_first() -> None:
    observed = observe_rolling(points_in_view(), VELOCITY, KINECT.seconds)
    compensate = RollingShutterCompensation(CAMERA)
    twice = compensate(compensate(observed, -2 * VELOCITY, KINECT), VELOCITY, KINECT)
    torch.testing.assert_close(twice.uv, compensate(observed, VELOCITY, KINECT).uv, rtol=0, atol=1e-9)
    torch.testing.assert_close(compensate(twice, AT_REST, KINECT).uv, observed.uv, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("velocity", "readout"), [(AT_REST, KINECT), (VELOCITY, GLOBAL_SHUTTER)])
def test_features_are_unchanged_at_rest_or_with_a_global_shutter(velocity: Tensor, readout: Readout) -> None:
    observed = observe_rolling(points_in_view(), VELOCITY, KINECT.seconds)
    assert torch.equal(RollingShutterCompensation(CAMERA)(observed, velocity, readout).uv, observed.uv)


def test_compensation_of_no_features_is_empty() -> None:
    observed = observe_rolling(points_in_view(), VELOCITY, KINECT.seconds)[torch.zeros(0, dtype=torch.int64)]
    assert len(RollingShutterCompensation(CAMERA)(observed, VELOCITY, KINECT)) == 0


# --- calibration of the readout


@settings(deadline=None, max_examples=50)
@given(st.floats(0, 0.03), st.floats(0, 0.03), st.floats(1e3, 1e8), st.floats(1e3, 1e8))
def test_calibration_with_a_quadratic_cost_is_the_weighted_mean(a: float, b: float, prior: float, new: float) -> None:
    calibrated = calibrate_readout(Readout(a, prior), slope=2 * new * (a - b), curvature=2 * new)
    assert calibrated.information == pytest.approx(0.8 * prior + 0.1 * new, rel=1e-12)
    assert calibrated.seconds == pytest.approx((0.8 * prior * a + 0.1 * new * b) / calibrated.information, abs=1e-9)


@pytest.mark.parametrize("curvature", [0.0, -1e6])
def test_calibration_ignores_a_cost_without_minimum(curvature: float) -> None:
    assert calibrate_readout(KINECT, slope=5.0, curvature=curvature) == KINECT


def test_calibration_keeps_a_certain_readout() -> None:
    assert calibrate_readout(GLOBAL_SHUTTER, slope=5.0, curvature=1e6) == GLOBAL_SHUTTER


def test_readout_of_a_camera_is_certain_if_given_else_the_prior() -> None:
    prior = Config().rolling_shutter
    assert Readout.from_camera(CAMERA, prior) == Readout(prior.readout, prior.readout_sigma**-2)
    assert Readout.from_camera(replace(CAMERA, readout=0.0), prior) == GLOBAL_SHUTTER
    assert calibrate_readout(Readout.from_camera(replace(CAMERA, readout=0.025), prior), 5.0, 1e6).seconds == 0.025


def test_calibrated_readout_is_at_most_the_longest_accepted() -> None:
    calibrated = calibrate_readout(Readout(0.01, 1.0), slope=-2e6 * 2.99, curvature=2e6)
    assert calibrated.seconds == pytest.approx(MAX_READOUT, abs=1e-6)


@pytest.mark.parametrize(
    "attributes", [{"seconds": 0.1, "information": 1.0}, {"seconds": math.nan, "information": 1.0}]
)
def test_readout_out_of_range_is_rejected(attributes: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="readout"):
        Readout.from_dict(attributes)


# --- in the map and in tracking


def map_of_two_keyframes(readout: Readout) -> SparseMap:
    """Map of two keyframes that observed the same points while the camera moved."""
    config = Config()
    sparse_map = SparseMap(config.mapping, config.features, CAMERA)
    sparse_map.readout = readout
    features = RollingShutterCompensation(CAMERA)(
        observe_rolling(points_in_view(), VELOCITY, KINECT.seconds), VELOCITY, readout
    )
    first = sparse_map.insert_keyframe(
        0, 0.0, torch.eye(4, dtype=torch.float64), features, torch.full((len(features),), -1)
    )
    sparse_map.insert_keyframe(1, 0.1, torch.eye(4, dtype=torch.float64), features, first.landmarks)
    return sparse_map


def test_set_readout_moves_all_features_and_observations() -> None:
    changed, expected = map_of_two_keyframes(Readout(0.010, 1.0)), map_of_two_keyframes(KINECT)
    changed.set_readout(KINECT)
    assert changed.readout == KINECT
    torch.testing.assert_close(changed.observations["uv"], expected.observations["uv"], rtol=0, atol=1e-9)
    for keyframe, expected_keyframe in zip(changed.keyframes, expected.keyframes, strict=True):
        torch.testing.assert_close(keyframe.features.uv, expected_keyframe.features.uv, rtol=0, atol=1e-9)


def test_update_features_moves_the_observations_of_that_keyframe_only() -> None:
    sparse_map = map_of_two_keyframes(KINECT)
    newest, others = sparse_map.keyframes[1], sparse_map.observations["keyframe"] == 0
    before = sparse_map.observations["uv"].clone()
    sparse_map.update_features(newest, RollingShutterCompensation(CAMERA)(newest.features, VELOCITY / 2, KINECT))
    assert torch.equal(sparse_map.observations["uv"][others], before[others])
    feature = sparse_map.observations["feature"][~others]
    assert torch.equal(sparse_map.observations["uv"][~others], newest.features.uv[feature])
    assert torch.equal(sparse_map.observations["readout_jacobian"][~others], newest.features.readout_jacobian[feature])
    assert not torch.equal(sparse_map.observations["uv"][~others], before[~others])


def test_pose_of_the_previous_frame_is_refined_with_a_better_velocity() -> None:
    """Bundle adjustment corrects keyframes; the poses between them are corrected here only."""
    config, T_cw = Config(), se3_exp(0.1 * VELOCITY)
    sparse_map = SparseMap(config.mapping, config.features, CAMERA)
    sparse_map.readout = KINECT
    first = sparse_map.insert_keyframe(
        0, 0.0, EYE, features_of(CAMERA.project(points_in_view()), points_in_view()[:, 2]), torch.full((200,), -1)
    )
    observed = observe_rolling(points_in_view() @ T_cw[:3, :3].T + T_cw[:3, 3], VELOCITY, KINECT.seconds)
    image, depth = torch.zeros(3, 480, 640, dtype=torch.uint8), torch.zeros(1, 480, 640)
    previous = TrackedFrame(RGBDFrame(1, 0.1, image, depth), depth, observed, landmarks=first.landmarks)
    refine = PreviousFrameRefinement(
        TimeCompensation(config, CAMERA),
        MapTracker(config.tracking, config.features, CAMERA),
        sparse_map,
        refine_pose=True,
    )

    motion = CameraMotion(T_cw, VELOCITY, torch.zeros(0, 2, dtype=torch.int64), is_measured=True)
    poses = PoseHistory()
    poses.append(0.0, FramePose(TrackingStatus.TRACKED, EYE, first.landmarks), motion, None, first)
    poses.append(0.1, FramePose(TrackingStatus.TRACKED, T_cw, first.landmarks), motion, first, None)
    errors = []
    for velocity in (AT_REST, VELOCITY / 2, VELOCITY):
        refine(previous, velocity, poses)
        errors.append(float(se3_log(poses.T_cw @ invert(T_cw)).norm()))
    assert errors[0] > 1.5 * errors[1] > 15 * errors[2]
    assert torch.equal(poses.trajectory().T_wc[0], EYE)  # the pose of the frame before is unchanged

    few = torch.where(torch.arange(200) < config.tracking.min_inliers - 1, first.landmarks, -1)
    before = poses.T_cw
    refine(replace(previous, landmarks=few), AT_REST, poses)
    refine(previous, None, poses)
    assert torch.equal(poses.T_cw, before)


def test_landmark_positions_are_those_of_active_landmarks() -> None:
    sparse_map = map_of_two_keyframes(KINECT)
    first = sparse_map.keyframes[0]
    landmark_ids = torch.where(torch.arange(len(first.landmarks)) % 2 == 0, first.landmarks, -1)
    sparse_map.landmarks["active"][landmark_ids[4]] = False
    found, points = sparse_map.landmark_positions(landmark_ids)
    assert found.tolist() == [i for i in range(0, len(landmark_ids), 2) if i != 4]
    assert torch.equal(points, sparse_map.landmarks["point"][first.landmarks[found]])


def test_selected_features_keep_their_readout_jacobian() -> None:
    observed = observe_rolling(points_in_view(), VELOCITY, KINECT.seconds)
    compensated = RollingShutterCompensation(CAMERA)(observed, VELOCITY, KINECT)
    assert torch.equal(compensated[torch.tensor([3, 1])].readout_jacobian, compensated.readout_jacobian[[3, 1]])


def test_readout_jacobian_is_zero_by_default() -> None:
    observed = observe_rolling(points_in_view(), VELOCITY, KINECT.seconds)
    assert torch.equal(observed.readout_jacobian, torch.zeros_like(observed.uv))
