"""Prediction of the camera's state, and its history."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.errors import InputError
from v3d_torch.geometry.se3 import invert, se3_exp, se3_log
from v3d_torch.odometry.odometry import CameraMotion
from v3d_torch.tracking.camera_state import CameraState
from v3d_torch.tracking.state_history import StateHistory
from v3d_torch.types import TrackingStatus

TWIST = torch.tensor([0.3, -0.1, 0.2, 0.5, 0.2, -0.4], dtype=torch.float64)
START = se3_exp(torch.tensor([1.0, 2.0, 3.0, 0.1, -0.7, 0.3], dtype=torch.float64))
SMALL = 1e-4 * torch.eye(6, dtype=torch.float64)


def state(stamp: float, T_wc: Tensor | None = None, status: TrackingStatus = TrackingStatus.TRACKED) -> CameraState:
    """State of a camera that moves with constant twist."""
    return CameraState(
        stamp=stamp,
        T_wc=START @ se3_exp(TWIST * stamp) if T_wc is None else T_wc,
        status=status,
        covariance=SMALL,
        twist=TWIST,
        twist_covariance=SMALL,
        cross_covariance=torch.zeros(6, 6, dtype=torch.float64),
    )


def history(*stamps: float) -> StateHistory:
    states = StateHistory()
    for stamp in stamps:
        states.append(state(stamp))
    return states


def test_prediction_follows_the_twist_and_stops_after_a_fifth_of_a_second() -> None:
    now = state(0.0)
    for elapsed in (0.0, 0.05, 0.2):
        torch.testing.assert_close(now.predict(elapsed).T_wc, START @ se3_exp(TWIST * elapsed))
        assert torch.equal(now.predict(elapsed).twist, TWIST)
    later = now.predict(3.0)
    torch.testing.assert_close(later.T_wc, START @ se3_exp(TWIST * 0.2))
    assert not later.twist.any() and later.stamp == 3.0


def test_prediction_without_a_frame_for_more_than_a_second_is_lost() -> None:
    """An unplugged camera was tracked for ever, with a standard deviation of 12.8 m after 8 s."""
    for status in TrackingStatus:
        now = state(5.0, status=status)
        assert [now.predict(stamp).status for stamp in (5.0, 5.2, 6.0)] == [status] * 3
        assert [now.predict(stamp).status for stamp in (6.01, 13.0)] == [TrackingStatus.LOST] * 2
    assert 0.9 < state(5.0).predict(6.0).covariance[:3, :3].trace().sqrt() < 1.1
    states = history(0.0, 5.0)
    assert states.at(4.0).status is TrackingStatus.TRACKED and states.at(6.01).status is TrackingStatus.LOST


@pytest.mark.parametrize("stamp", [0.9, -10.0, math.nan])
def test_prediction_of_an_earlier_time_is_an_input_error(stamp: float) -> None:
    """Its covariance would have negative eigenvalues."""
    with pytest.raises(InputError, match=rf"no prediction for {stamp:.6f} s: the state is of 1\.000000 s;"):
        state(1.0).predict(stamp)


def test_prediction_of_an_infinite_time_is_an_input_error() -> None:
    """Its covariance was NaN."""
    with pytest.raises(InputError, match=r"^no prediction for inf s: the time is not finite; give seconds$"):
        state(1.0).predict(math.inf)


def test_covariance_of_a_prediction_grows_with_time() -> None:
    now = state(0.0)
    torch.testing.assert_close(now.predict(0.0).covariance, now.covariance)
    covariances = [now.predict(elapsed).covariance for elapsed in (0.0, 0.02, 0.1, 0.2, 0.3, 1.0, 10.0)]
    for a, b in itertools.pairwise(covariances):
        assert float(b.det()) > float(a.det()) and float(b.trace()) > float(a.trace())
    assert covariances[-1][:3, :3].trace().sqrt() > 10  # after ten seconds anywhere in the room


def test_covariance_of_a_prediction_covers_motions_of_a_hand() -> None:
    """Poses after a quarter of a second of white acceleration noise have the predicted covariance (Monte Carlo)."""
    generator = torch.Generator().manual_seed(0)
    steps, runs, elapsed = 50, 2000, 0.2
    dt = elapsed / steps
    sigma = torch.tensor([1.0] * 3 + [2.0] * 3, dtype=torch.float64)
    twist = TWIST + 1e-2 * torch.randn(runs, 6, dtype=torch.float64, generator=generator)
    T = START @ se3_exp(1e-2 * torch.randn(runs, 6, dtype=torch.float64, generator=generator))
    for _ in range(steps):
        T = T @ se3_exp(twist * dt)
        twist = twist + sigma * dt**0.5 * torch.randn(runs, 6, dtype=torch.float64, generator=generator)
    predicted = state(0.0).predict(elapsed)
    errors = se3_log(invert(predicted.T_wc) @ T)
    nees = (errors @ torch.linalg.inv(predicted.covariance) * errors).sum(dim=1).mean()
    assert abs(float(nees) - 6) < 0.4  # within the noise of 2,000 runs, discretisation, and curvature


def test_pose_between_frames_is_interpolated_along_the_geodesic() -> None:
    states = history(1.0, 1.1, 1.2)
    for stamp in (1.0, 1.03, 1.1, 1.17, 1.2):
        torch.testing.assert_close(states.at(stamp).T_wc, START @ se3_exp(TWIST * stamp))
        assert states.at(stamp).stamp == stamp
    torch.testing.assert_close(states.at(1.25).T_wc, START @ se3_exp(TWIST * 1.25))  # predicted


@settings(max_examples=20)
@given(st.floats(0, 1), st.integers(0, 10_000))
def test_interpolated_covariance_is_an_upper_bound(fraction: float, seed: int) -> None:
    """It exceeds the covariance of the interpolated pose for independent and for equal errors of both frames."""
    generator = torch.Generator().manual_seed(seed)
    roots = torch.randn(2, 6, 6, dtype=torch.float64, generator=generator)
    a, b = roots @ roots.mT
    still = torch.eye(4, dtype=torch.float64)
    states = StateHistory()
    for stamp, covariance in ((0.0, a), (1.0, b)):
        states.append(CameraState(**{**vars(state(stamp, still)), "covariance": covariance}))
    got = states.at(fraction).covariance
    independent = (1 - fraction) ** 2 * a + fraction**2 * b
    assert torch.linalg.eigvalsh(got - independent).min() > -1e-9
    root = (1 - fraction) * torch.linalg.cholesky(a) + fraction * torch.linalg.cholesky(b)
    assert torch.linalg.eigvalsh(got - root @ root.T).min() > -1e-9


@pytest.mark.parametrize("end", [0, 1])
def test_error_of_a_frame_turns_with_the_camera_between_frames(end: int) -> None:
    """Along the interpolated path the error of either frame is rigidly attached to the camera there."""
    poses = START, START @ se3_exp(torch.tensor([0.3, -0.5, 0.1, 0.4, -0.2, 0.3], dtype=torch.float64))
    covariance, fraction = torch.arange(1.0, 7.0).double().diag(), 0.4
    between = []
    for uncertain in (covariance, 0 * covariance):
        states = StateHistory()
        for index, T_wc in enumerate(poses):
            own = uncertain if index == end else 0 * covariance
            states.append(replace(state(0.2 * index, T_wc), covariance=own))
        between.append(states.at(0.2 * fraction))
    to_end = invert(poses[end]) @ between[0].T_wc
    jacobian = torch.autograd.functional.jacobian(
        lambda error: se3_log(invert(to_end) @ se3_exp(error) @ to_end), torch.zeros(6, dtype=torch.float64)
    )
    expected = (1 - fraction, fraction)[end] * jacobian @ covariance @ jacobian.T
    torch.testing.assert_close(between[0].covariance - between[1].covariance, expected)


def test_status_between_frames_is_that_of_the_nearer_frame() -> None:
    states = StateHistory()
    states.append(state(1.0, status=TrackingStatus.TRACKED))
    states.append(state(1.1, status=TrackingStatus.LOST))
    assert states.at(1.04).status is TrackingStatus.TRACKED and states.at(1.06).status is TrackingStatus.LOST


def test_errors_of_pose_and_twist_between_frames_correlate_as_at_both_frames() -> None:
    still, states = torch.eye(4, dtype=torch.float64), StateHistory()
    for stamp, correlation in ((0.0, -0.8), (1.0, 0.4)):
        states.append(replace(state(stamp, still), cross_covariance=correlation * SMALL))
    torch.testing.assert_close(states.at(0.25).cross_covariance, -0.5 * SMALL)


def test_covariance_between_frames_covers_motions_of_a_hand() -> None:
    """Paths of white acceleration noise, whose ends are known, have the covariance at a time between (Monte Carlo)."""
    generator = torch.Generator().manual_seed(0)
    steps, runs, elapsed, stamp = 40, 1000, 0.2, 0.05
    dt = elapsed / steps
    sigma = torch.tensor([1.0] * 3 + [2.0] * 3, dtype=torch.float64)
    twist, T, known = TWIST.expand(runs, 6), START.expand(runs, 4, 4), []
    for _ in range(steps + 1):
        known.append((T, twist))
        noise = sigma * dt**0.5 * torch.randn(runs, 6, dtype=torch.float64, generator=generator)
        T, twist = T @ se3_exp((twist + noise / 2) * dt), twist + noise
    (true_T, true_twist), errors = known[round(stamp / dt)], []
    for run in range(runs):
        states = StateHistory()
        for time, (pose, velocity) in ((0.0, known[0]), (elapsed, known[-1])):
            states.append(replace(state(time, pose[run]), covariance=0 * SMALL, twist=velocity[run]))
        between = states.at(stamp)
        errors.append(torch.cat([se3_log(invert(between.T_wc) @ true_T[run]), true_twist[run] - between.twist]))
    variance = torch.stack(errors).square().mean(dim=0)
    expected = torch.cat([between.covariance.diagonal(), (between.twist_covariance - SMALL).diagonal()])
    torch.testing.assert_close(variance, expected, rtol=0.2, atol=0.0)


def test_covariance_in_a_gap_of_the_frames_covers_any_motion_within_it() -> None:
    states = history(0.0, 2.0)
    assert states.at(1.0).covariance[:3, :3].diagonal().sqrt().min() > 0.4  # the camera can move away and back
    assert history(0.0, 0.03).at(0.015).covariance[:3, :3].diagonal().sqrt().max() < 0.0101


def test_times_that_are_not_kept_are_input_errors() -> None:
    with pytest.raises(InputError, match="no frame has been tracked; track a frame first"):
        StateHistory().at(1.0)
    states = history(*(n / 10 for n in range(200)))
    for stamp in (math.nan, math.inf):
        with pytest.raises(InputError, match=f"^no state at {stamp} s: the time is not finite$"):
            states.at(stamp)
    with pytest.raises(InputError, match=r"only states of the last 10 s are stored, since 9\.800000 s"):
        states.at(9.0)
    last = states.at(86_419.0)
    assert float(last.covariance.diagonal().min()) > 1e14 and bool(last.covariance.isfinite().all())
    with pytest.raises(InputError, match=r"^no state at 1\.7e\+18 s: the last frame is of 19\.900000 s; give a time"):
        states.at(1.7e18)


def test_only_the_states_of_the_last_ten_seconds_are_kept() -> None:
    states = StateHistory()
    one = state(0.0)
    for n in range(3000):
        states.append(CameraState(**{**vars(one), "stamp": n / 30}))
    assert len(states.state_dict()["states"]) == 301


def test_pose_ten_seconds_before_the_last_frame_is_interpolated() -> None:
    states = history(1.0, 1.3, 1.6, 11.4)
    assert [each.stamp for each in states.state_dict()["states"]] == [1.3, 1.6, 11.4]
    torch.testing.assert_close(states.at(1.4).T_wc, START @ se3_exp(TWIST * 1.4))


def test_correction_of_the_world_moves_all_states() -> None:
    states = history(1.0, 1.1)
    T_new_old = se3_exp(torch.tensor([0.5, 0, 0, 0, 0.3, 0], dtype=torch.float64))
    states.apply_world_correction(T_new_old)
    torch.testing.assert_close(states.at(1.05).T_wc, T_new_old @ START @ se3_exp(TWIST * 1.05))
    restored = StateHistory()
    restored.load_state_dict(states.state_dict())
    assert torch.equal(restored.at(1.05).T_wc, states.at(1.05).T_wc)


def measured_motion(is_measured: bool) -> CameraMotion:
    """Motion of the camera in a tenth of a second, a little faster than predicted."""
    T_cp = se3_exp(-0.11 * TWIST)
    return CameraMotion(T_cp, -1.1 * TWIST, torch.zeros(0, 2, dtype=torch.int64), is_measured)


def test_measured_motion_is_known_before_the_frame_is_tracked_in_the_map() -> None:
    states = history(0.0, 0.1)
    states.append_motion(0.2, measured_motion(is_measured=True))
    early = states.at(0.2)
    torch.testing.assert_close(early.T_wc, START @ se3_exp(0.21 * TWIST))
    torch.testing.assert_close(early.twist, 1.1 * TWIST)
    assert float(early.covariance.det()) > float(state(0.1).covariance.det())
    torch.testing.assert_close(states.at(0.25).T_wc, early.T_wc @ se3_exp(0.055 * TWIST))
    states.append(state(0.2))
    torch.testing.assert_close(states.at(0.2).T_wc, state(0.2).T_wc)
    assert len(states.state_dict()["states"]) == 3


def test_motion_that_was_measured_over_a_gap_keeps_the_status() -> None:
    states = history(0.0, 0.1)
    states.append_motion(3.0, measured_motion(is_measured=True))
    assert states.at(3.0).status is states.at(3.9).status is TrackingStatus.TRACKED
    assert states.at(4.1).status is TrackingStatus.LOST


def test_motion_that_was_not_measured_changes_no_state() -> None:
    states, empty = history(0.0, 0.1), StateHistory()
    for each in (states, empty):
        each.append_motion(0.2, measured_motion(is_measured=False))
    empty.append_motion(0.2, measured_motion(is_measured=True))
    assert len(states.state_dict()["states"]) == 2 and not empty.state_dict()["states"]
