"""Constant-velocity Kalman filter against least squares, and its speed limit."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import lstsq
from scipy.stats import chi2

from v3d_torch.config import TrackerConfig
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.objects.kalman_filter import ConstantVelocityKalmanFilter
from v3d_torch.objects.object_state import ObjectState


@settings(max_examples=20)
@given(st.lists(st.tuples(st.floats(0.01, 0.5), st.floats(-0.3, 0.3), st.floats(0.02, 0.5)), min_size=1, max_size=8))
def test_kalman_filter_equals_least_squares(steps: list[tuple[float, float, float]]) -> None:
    """Oracle: SciPy solves for the states at all times at once, with whitened residuals."""
    config = TrackerConfig(max_speed=1e6, acceleration_noise=1.5)
    motion = ConstantVelocityKalmanFilter(config)
    stamp = 7.0
    motion.update(stamp, torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), 0.1)
    size = 2 * len(steps) + 2
    rows, right = [np.eye(size)[0] / 0.1, np.eye(size)[1]], [1.0 / 0.1, 0.0]  # first position, first velocity
    for k, (dt, error, sigma) in enumerate(steps):
        stamp += dt
        x = 1.0 + 0.8 * (stamp - 7.0) + error
        motion.update(stamp, torch.tensor([x, 2.0, 3.0], dtype=torch.float64), sigma)
        noise = 1.5**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        step = np.zeros((2, size))
        step[:, 2 * k : 2 * k + 4] = [[-1, -dt, 1, 0], [0, -1, 0, 1]]
        rows += [*np.linalg.inv(np.linalg.cholesky(noise)) @ step, np.eye(size)[2 * k + 2] / sigma]
        right += [0.0, 0.0, x / sigma]
    position, velocity = lstsq(np.stack(rows), np.array(right))[0][-2:]
    expected = torch.tensor([position + 0.2 * velocity, 2.0, 3.0], dtype=torch.float64)
    torch.testing.assert_close(motion.state.predict(stamp + 0.2).position, expected, rtol=0.0, atol=1e-7)
    torch.testing.assert_close(motion.state.velocity, torch.tensor([velocity, 0.0, 0.0], dtype=torch.float64))


def test_kalman_filter_limits_the_speed() -> None:
    motion = ConstantVelocityKalmanFilter(TrackerConfig(max_speed=2.0))
    for frame in range(10):
        motion.update(0.1 * frame, torch.tensor([0.9, 0.0, 1.2], dtype=torch.float64) * frame, 0.05)
    torch.testing.assert_close(motion.state.velocity, torch.tensor([1.2, 0.0, 1.6], dtype=torch.float64))


def test_covariance_of_the_filter_is_that_of_its_errors() -> None:
    """Monte Carlo: walks with white acceleration noise; 500 errors of position and velocity, whitened."""
    generator, config = np.random.default_rng(0), TrackerConfig(max_speed=1e6, acceleration_noise=2.0)
    dt, sigma, squared = 0.1, 0.05, []
    noise = 2.0**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    step = np.linalg.cholesky(noise)
    for _ in range(500):
        motion = ConstantVelocityKalmanFilter(config)
        position, velocity = np.zeros(3), generator.normal(size=3)
        for k in range(15):
            measured = position + sigma * generator.normal(size=3)
            motion.update(k * dt, torch.from_numpy(measured), sigma)
            change = step @ generator.normal(size=(2, 3))
            position, velocity = position + dt * velocity + change[0], velocity + change[1]
        predicted = motion.state.predict(15 * dt)
        error = np.concatenate([predicted.position.numpy() - position, predicted.velocity.numpy() - velocity])
        squared.append(error @ np.linalg.solve(predicted.covariance.numpy(), error))
    low, high = chi2.ppf([0.001, 0.999], 6 * len(squared)) / len(squared)
    assert low < np.mean(squared) < high


def test_state_is_transformed_with_the_world() -> None:
    T = se3_exp(torch.tensor([0.3, -0.1, 0.2, 0.4, 0.5, -0.6], dtype=torch.float64))
    position, velocity = torch.rand(2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    state = ObjectState(1.0, position, velocity, (1.0, 0.1, 2.0), 2.0)
    later, moved = state.predict(1.7), state.transform(T).predict(1.7)
    torch.testing.assert_close(moved.position, T[:3, :3] @ later.position + T[:3, 3])
    assert moved.variances == later.variances
    assert torch.equal(state.covariance, state.covariance.T) and state.sigmas == (1.0, math.sqrt(2.0))


def make_state() -> ObjectState:
    position, velocity = torch.rand(2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return ObjectState(1.0, position, velocity, (1.0, 0.1, 2.0), 1.5)


def test_prediction_with_decay_is_the_same_in_one_step_and_in_two() -> None:
    once = make_state().predict_with_decay(4.0, 0.7)
    twice = make_state().predict_with_decay(1.4, 0.7).predict_with_decay(4.0, 0.7)
    torch.testing.assert_close(once.position, twice.position)
    torch.testing.assert_close(once.covariance, twice.covariance)


def test_prediction_with_slow_decay_has_constant_velocity() -> None:
    slow, constant = make_state().predict_with_decay(1.5, 1e4), make_state().predict(1.5)
    torch.testing.assert_close(slow.position, constant.position, rtol=1e-4, atol=0.0)
    torch.testing.assert_close(slow.covariance, constant.covariance, rtol=1e-4, atol=0.0)


def test_prediction_with_decay_stops_within_the_time_constant() -> None:
    state = make_state()
    later = state.predict_with_decay(100.0, 0.7)
    torch.testing.assert_close(later.position, state.position + 0.7 * state.velocity)
    assert later.sigmas[1] == pytest.approx(1.5 * math.sqrt(0.7 / 2))  # speed of a person


def test_object_at_rest_is_predicted_where_it_was() -> None:
    state = make_state()
    later = state.predict_at_rest(100.0)
    assert later.stamp == 100.0 and torch.equal(later.position, state.position)
    assert not later.velocity.any() and later.sigmas == (state.sigmas[0], 0.0)


def test_variance_of_the_motion_is_that_of_a_prediction_from_a_known_position() -> None:
    state = replace(make_state(), variances=(0.0, 0.0, 2.0))
    assert state.motion_variance(0.4) == pytest.approx(state.predict(1.4).variances[0])
