"""Odometry falls back to dense alignment if features fail, and reports no motion if both fail."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from v3d_torch.config.loading import load_config
from v3d_torch.datasets import RGBDSequence, load_sequence
from v3d_torch.evaluation import evaluate
from v3d_torch.features.orb import ORB
from v3d_torch.geometry.se3 import invert, se3_log
from v3d_torch.odometry.motion_estimator import MotionEstimator, RelativeMotion
from v3d_torch.odometry.odometry import Odometry, TrackedFrame
from v3d_torch.segmentation import NoSegmentation
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import RGBDFrame, TrackingStatus

NO_FEATURES = "odometry.min_inliers=100000"
IDENTITY = torch.eye(4, dtype=torch.float64)


@pytest.fixture(scope="module")
def demo() -> RGBDSequence:
    return load_sequence("demo")


def estimate_motion(
    demo: RGBDSequence, previous: int, current: int, *overrides: str
) -> tuple[RelativeMotion | None, Tensor]:
    """Estimated and true motion between two frames; all pixels of the first count as static."""
    config = load_config(None, overrides)
    detect = ORB(config.features, demo.camera)
    a, b = (
        TrackedFrame(frame, frame.depth, detect(frame.image, frame.depth)) for frame in (demo[previous], demo[current])
    )
    a = TrackedFrame(a.frame, a.depth, a.features, torch.ones(a.depth.shape[-2:], dtype=torch.bool))
    register = MotionEstimator(config.odometry, config.features, demo.camera, config.seed)
    assert demo.groundtruth is not None
    rows = [int((demo.groundtruth.stamps - view.frame.stamp).abs().argmin()) for view in (a, b)]
    T_wa, T_wb = demo.groundtruth.T_wc[rows]
    return Odometry(config, demo.camera, register)(a, b, IDENTITY), invert(T_wb) @ T_wa


@pytest.mark.parametrize("current", [1, 3])
def test_dense_alignment_gives_the_motion_without_features(demo: RGBDSequence, current: int) -> None:
    motion, T_ba = estimate_motion(demo, 0, current, NO_FEATURES)
    assert motion is not None and motion.pairs.shape == (0, 2)
    error = se3_log(motion.T_ba @ invert(T_ba))
    assert float(error[:3].norm()) < 0.003 and float(error[3:].norm()) < 0.002


def test_features_are_tried_first(demo: RGBDSequence) -> None:
    motion, _ = estimate_motion(demo, 0, 1)
    assert motion is not None and len(motion.pairs) > 100


def test_implausible_motion_is_rejected(demo: RGBDSequence) -> None:
    assert estimate_motion(demo, 0, 3, NO_FEATURES, "odometry.max_speed=0.001")[0] is None


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
