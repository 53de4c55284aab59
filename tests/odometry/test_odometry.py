"""Odometry: registration by features, else by dense alignment, else prediction; and results for the features."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from v3d_torch.config.loading import load_config
from v3d_torch.datasets import RGBDSequence
from v3d_torch.evaluation import evaluate
from v3d_torch.features.orb import ORB
from v3d_torch.geometry.se3 import invert, se3_log
from v3d_torch.odometry.motion_estimator import MotionEstimator
from v3d_torch.odometry.odometry import CameraMotion, Odometry, TrackedFrame
from v3d_torch.segmentation import NoSegmentation
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import RGBDFrame, TrackingStatus

NO_FEATURES = "odometry.min_inliers=100000"
NO_MOTION = "odometry.max_speed=0.001"  # every measured motion is implausible
PREDICTED_T_CP = torch.eye(4, dtype=torch.float64)
PREDICTED_VELOCITY = torch.tensor([0.01, -0.02, 0.03, 0.04, -0.05, 0.06], dtype=torch.float64)  # m/s and rad/s
PAIRS = torch.tensor([[4, 0], [2, 3], [0, 5]])


@dataclass(frozen=True)
class TwoFrames:
    """Two frames of the demo sequence, their odometry and the true motion between them."""

    odometry: Odometry
    previous: TrackedFrame
    current: TrackedFrame
    T_cp: Tensor

    @property
    def elapsed(self) -> float:
        return self.current.frame.stamp - self.previous.frame.stamp

    def estimate(self) -> CameraMotion:
        return self.odometry(self.previous, self.current, PREDICTED_T_CP, PREDICTED_VELOCITY)


def two_frames(demo: RGBDSequence, previous: int, current: int, *overrides: str) -> TwoFrames:
    """Two frames of the demo sequence; all pixels of the previous one count as static."""
    config = load_config(None, overrides)
    detect = ORB(config.features, demo.camera)
    a, b = (
        TrackedFrame(frame, frame.depth, detect(frame.image, frame.depth)) for frame in (demo[previous], demo[current])
    )
    a = replace(a, static_mask=torch.ones(a.depth.shape[-2:], dtype=torch.bool))
    register = MotionEstimator(config.odometry, config.features, demo.camera, config.seed)
    assert demo.groundtruth is not None
    rows = [int((demo.groundtruth.stamps - view.frame.stamp).abs().argmin()) for view in (a, b)]
    T_wp, T_wc = demo.groundtruth.T_wc[rows]
    return TwoFrames(Odometry(config, demo.camera, register), a, b, invert(T_wc) @ T_wp)


@pytest.mark.parametrize("current", [1, 3])
def test_dense_alignment_gives_the_motion_without_features(demo: RGBDSequence, current: int) -> None:
    frames = two_frames(demo, 0, current, NO_FEATURES)
    motion = frames.estimate()
    assert motion.is_measured and motion.inlier_matches.shape == (0, 2)
    error = se3_log(motion.T_cp @ invert(frames.T_cp))
    assert float(error[:3].norm()) < 0.003 and float(error[3:].norm()) < 0.002


def test_features_are_tried_first(demo: RGBDSequence) -> None:
    motion = two_frames(demo, 0, 1).estimate()
    assert motion.is_measured and len(motion.inlier_matches) > 100


@pytest.mark.parametrize("overrides", [(), (NO_FEATURES,)], ids=["features", "dense"])
def test_velocity_of_a_measured_motion_is_its_mean_twist(demo: RGBDSequence, overrides: tuple[str, ...]) -> None:
    frames = two_frames(demo, 0, 3, *overrides)
    motion = frames.estimate()
    assert motion.is_measured
    torch.testing.assert_close(motion.velocity * frames.elapsed, se3_log(motion.T_cp), rtol=1e-12, atol=1e-15)


def test_measured_motion_is_that_of_the_registration(demo: RGBDSequence) -> None:
    frames = two_frames(demo, 0, 1)
    motion = frames.estimate()
    registered = frames.odometry.register(frames.previous, frames.current, PREDICTED_T_CP)
    assert registered is not None
    assert torch.equal(motion.T_cp, registered.T_ba) and torch.equal(motion.inlier_matches, registered.inlier_matches)


def test_implausible_motion_is_rejected_and_the_prediction_returned(demo: RGBDSequence) -> None:
    frames = two_frames(demo, 0, 3, NO_FEATURES, NO_MOTION)
    assert frames.odometry.register(frames.previous, frames.current, PREDICTED_T_CP) is None
    assert_predicted(frames.estimate())


def test_motion_of_the_first_frame_is_the_prediction(demo: RGBDSequence) -> None:
    frames = two_frames(demo, 0, 1)
    assert_predicted(frames.odometry(None, frames.current, PREDICTED_T_CP, PREDICTED_VELOCITY))


def assert_predicted(motion: CameraMotion) -> None:
    assert (
        not motion.is_measured and motion.inlier_matches.shape == (0, 2) and motion.inlier_matches.dtype == torch.int64
    )
    assert torch.equal(motion.T_cp, PREDICTED_T_CP) and torch.equal(motion.velocity, PREDICTED_VELOCITY)


def test_inlier_mask_selects_the_matched_features_of_the_current_frame() -> None:
    motion = CameraMotion(PREDICTED_T_CP, PREDICTED_VELOCITY, PAIRS, is_measured=True)
    assert motion.inlier_mask(7).tolist() == [True, False, False, True, False, True, False]
    assert not replace(motion, inlier_matches=PAIRS[:0]).inlier_mask(7).any()


def test_residuals_are_displacements_against_the_motion(demo: RGBDSequence) -> None:
    """Matched features lie where the measured motion moves the points of the previous frame, nearly all by a pixel."""
    frames = two_frames(demo, 0, 1)
    motion = frames.estimate()
    residuals = motion.residuals(frames.previous, frames.current.features, demo.camera)
    assert residuals.shape == (len(frames.current.features), 2)
    matched = residuals[:, 0].isfinite()
    assert set(motion.matches[:, 1].tolist()) == set(torch.nonzero(matched)[:, 0].tolist())
    inliers = motion.inlier_mask(len(residuals))
    assert bool(matched[inliers].all()) and int(matched.sum()) > int(inliers.sum())
    assert residuals[inliers].norm(dim=1).median() < 1.0
    moved = replace(frames.current.features, uv=frames.current.features.uv + torch.tensor([3.0, -2.0]).double())
    difference = motion.residuals(frames.previous, moved, demo.camera) - residuals
    torch.testing.assert_close(difference[matched], torch.tensor([3.0, -2.0]).double().expand(int(matched.sum()), 2))
    assert motion.residuals(None, moved, demo.camera).isnan().all()


def test_landmarks_are_propagated_by_the_inlier_matches(demo: RGBDSequence) -> None:
    motion = CameraMotion(PREDICTED_T_CP, PREDICTED_VELOCITY, PAIRS, is_measured=True)
    previous = replace(two_frames(demo, 0, 1).previous, landmarks=torch.tensor([10, 11, -1, 13, 14]))
    assert motion.propagate_landmarks(previous, 7).tolist() == [14, -1, -1, -1, -1, 10, -1]
    assert motion.propagate_landmarks(replace(previous, landmarks=None), 7).tolist() == 7 * [-1]
    assert motion.propagate_landmarks(None, 7).tolist() == 7 * [-1]


def test_slam_without_features_tracks_by_dense_odometry(demo: RGBDSequence) -> None:
    slam = V3DSLAM(demo.camera, NoSegmentation(), load_config(None, (NO_FEATURES, "tracking.min_inliers=100000")))
    for index in range(12):
        slam(demo[index])
    assert slam.poses.statuses == [TrackingStatus.TRACKED] + 11 * [TrackingStatus.ODOMETRY]
    assert demo.groundtruth is not None
    assert evaluate(demo.groundtruth, slam.poses.trajectory(), frames=12).ate.rmse < 0.002


def test_slam_is_lost_while_the_camera_is_covered(demo: RGBDSequence) -> None:
    def covered(frame: RGBDFrame) -> RGBDFrame:
        return replace(frame, image=torch.full_like(frame.image, 3), depth=torch.zeros_like(frame.depth))

    slam = V3DSLAM(demo.camera, NoSegmentation(), load_config(None, ()))
    for index in range(18):
        slam(covered(demo[index]) if 6 <= index < 12 else demo[index])
    assert slam.poses.statuses == 6 * [TrackingStatus.TRACKED] + 6 * [TrackingStatus.LOST] + 6 * [
        TrackingStatus.TRACKED
    ]
    assert demo.groundtruth is not None
    # The poses of lost frames are interpolated.
    assert evaluate(demo.groundtruth, slam.poses.trajectory(), frames=18).ate.rmse < 0.004
