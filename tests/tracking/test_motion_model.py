"""Motion model: predicted poses and velocities."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.moving_camera import EYE, TWIST, Camera, frame_pose, twists, walk
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.types import MIN_INTERVAL, TrackingStatus


def test_history_without_frames_is_at_the_origin() -> None:
    camera = Camera()
    assert camera.poses.status is None and camera.poses.statuses == []
    assert torch.equal(camera.poses.T_cw, EYE)
    assert torch.equal(camera.predict(3.0), EYE)


@settings(max_examples=30)
@given(twists, st.floats(0.01, 0.1), st.floats(0.01, 0.2))
def test_prediction_of_constant_velocity_is_exact(twist: Tensor, step: float, ahead: float) -> None:
    camera = Camera()
    for stamp in (0.0, step):
        camera.append(stamp, frame_pose(se3_exp(twist * stamp)), None)
    torch.testing.assert_close(camera.predict(step + ahead), se3_exp(twist * (step + ahead)), rtol=0, atol=1e-9)


def test_convention_velocity_acts_in_the_camera_frame() -> None:
    """A camera that rotates in place far from the origin is predicted to stay there."""
    T_wc = EYE.clone()
    T_wc[:3, 3] = torch.tensor([10.0, -5.0, 3.0])
    turn = torch.tensor([0, 0, 0, 0, 0.5, 0], dtype=torch.float64)
    camera = Camera()
    for stamp in (0.0, 0.1):
        camera.append(stamp, frame_pose(invert(T_wc @ se3_exp(turn * stamp))), None)
    predicted = invert(camera.predict(0.2))
    torch.testing.assert_close(predicted[:3, 3], T_wc[:3, 3], rtol=0, atol=1e-9)
    torch.testing.assert_close(predicted, T_wc @ se3_exp(turn * 0.2), rtol=0, atol=1e-9)


def test_prediction_extrapolates_at_most_a_fifth_of_a_second() -> None:
    camera = walk([0.0, 0.1])
    torch.testing.assert_close(camera.predict(5.0), se3_exp(TWIST * 0.3), rtol=0, atol=1e-9)


def test_velocity_is_expected_for_a_fifth_of_a_second() -> None:
    camera = walk([0.0, 0.1])
    prediction = camera.model.predict(camera.poses)
    torch.testing.assert_close(prediction.velocity_at(0.25), TWIST)
    assert torch.equal(prediction.velocity_at(0.31), torch.zeros_like(TWIST))


def test_velocity_of_a_camera_that_is_found_after_a_gap_is_unknown() -> None:
    camera = walk([0.0, 0.1])
    camera.append(5.0, replace(frame_pose(EYE), is_relocalised=True), None)
    assert torch.equal(camera.model.velocity, torch.zeros_like(TWIST))


def test_prediction_of_a_lost_camera_continues_shortly_and_then_stands_still() -> None:
    stamps = [k / 30 for k in range(40)]
    camera = walk(stamps[:10])
    positions = []
    for stamp in stamps[10:]:
        positions.append(invert(camera.predict(stamp))[:3, 3])
        camera.append(stamp, frame_pose(camera.predict(stamp), TrackingStatus.LOST), None)
    steps = torch.stack(positions).diff(dim=0).norm(dim=1)
    speed = float(TWIST[:3].norm())
    assert steps[:4].min() > 0.9 * speed / 30  # continues
    assert (steps[8:] < 1e-12).all()  # stands still
    assert steps.sum() < 0.3 * speed


def test_velocity_between_frames_that_were_received_at_once_is_not_larger_than_that_of_the_camera() -> None:
    camera = Camera()
    camera.append(0.0, frame_pose(EYE), None)
    camera.append(1e-4, frame_pose(se3_exp(MIN_INTERVAL * TWIST)), None)
    torch.testing.assert_close(camera.model.velocity, TWIST, rtol=0, atol=1e-9)


def test_velocity_of_a_lost_camera_follows_measured_motions() -> None:
    """The rolling shutter is compensated with this velocity."""
    camera, step = walk([0.0, 0.1]), se3_exp(-0.1 * TWIST)
    for k in range(2, 20):
        camera.append(0.1 * k, frame_pose(step @ camera.poses.T_cw, TrackingStatus.LOST), None, step)
        torch.testing.assert_close(camera.model.velocity, -TWIST, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("is_measured", "expected"), [(True, 1.5), (False, 2.0)])
def test_velocity_at_a_frame_is_the_mean_of_the_measured_motions_before_and_after_it(
    is_measured: bool, expected: float
) -> None:
    """The camera doubles its velocity in the frame."""
    camera, before, after = Camera(), se3_exp(-0.1 * TWIST), se3_exp(-0.2 * TWIST)
    camera.append(0.0, frame_pose(EYE), None)
    camera.append(0.1, frame_pose(before), None, before if is_measured else None)
    camera.append(0.2, frame_pose(after @ before), None, after)
    torch.testing.assert_close(camera.previous_velocity, -expected * TWIST)


def test_jump_of_a_relocalised_camera_is_not_a_velocity() -> None:
    camera = walk([0.0, 1 / 30], lost=())
    for k in range(2, 20):
        camera.append(k / 30, frame_pose(camera.poses.T_cw, TrackingStatus.LOST), None)
    away = se3_exp(torch.tensor([2.0, 0, 0, 0, 0, 0], dtype=torch.float64))
    camera.append(20 / 30, frame_pose(away), None)
    torch.testing.assert_close(camera.predict(21 / 30), away, rtol=0, atol=1e-12)


def test_jump_of_a_camera_relocalised_after_odometry_is_not_a_velocity() -> None:
    step, away = se3_exp(TWIST / 30), se3_exp(torch.tensor([2.0, 0, 0, 0, 0, 0], dtype=torch.float64))
    for T_cp in (None, step):
        camera = walk([0.0, 1 / 30])
        for k in range(2, 20):
            camera.append(k / 30, frame_pose(step @ camera.poses.T_cw, TrackingStatus.ODOMETRY), None, step)
        camera.append(20 / 30, replace(frame_pose(away), is_relocalised=True), None, T_cp)
        torch.testing.assert_close(camera.predict(21 / 30), step @ away, rtol=0, atol=1e-9)
