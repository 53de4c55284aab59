"""Constant-velocity Kalman filter against least squares, and its speed limit."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import lstsq
from scipy.stats import chi2

from v3d_torch.config import TrackerConfig
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.objects.kalman_filter import ConstantVelocityKalmanFilter
from v3d_torch.objects.object_state import ObjectState

NOISE = 0.04
"""Standard deviation of a measured centroid, as in the filter, metres."""

SLOW = 0.5
"""Fraction of the variance of the offset that changes slowly."""


@settings(max_examples=20)
@given(st.lists(st.tuples(st.floats(0.01, 0.5), st.floats(-0.3, 0.3), st.floats(0.02, 0.5)), min_size=1, max_size=8))
def test_kalman_filter_equals_least_squares(steps: list[tuple[float, float, float]]) -> None:
    """Oracle: SciPy solves for position, velocity and offset at all times at once, with whitened residuals."""
    motion = ConstantVelocityKalmanFilter(TrackerConfig(max_speed=1e6, acceleration_noise=1.5))
    stamp, before = 7.0, 0.1
    motion.update(stamp, torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), before)
    size = 4 * len(steps) + 4
    unit = np.eye(size)  # of each time: position, velocity, slow and fast part of the offset
    rows, right = [unit[1], unit[2] / (SLOW**0.5 * before)], [0.0, 0.0]

    def measure(k: int, x: float, sigma: float) -> None:
        rows.extend(
            [unit[4 * k + 3] / ((1 - SLOW) ** 0.5 * sigma), (unit[4 * k] + unit[4 * k + 2] + unit[4 * k + 3]) / NOISE]
        )
        right.extend([0.0, x / NOISE])

    measure(0, 1.0, before)
    for k, (dt, error, sigma) in enumerate(steps):
        stamp += dt
        x, correlation = 1.0 + 0.8 * (stamp - 7.0) + error, math.exp(-dt / 2.0)
        motion.update(stamp, torch.tensor([x, 2.0, 3.0], dtype=torch.float64), sigma)
        noise = np.zeros((3, 3))
        noise[:2, :2] = 1.5**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        noise[2, 2] = SLOW * sigma**2 * (1 - correlation**2)
        step = np.zeros((3, size))
        step[:, 4 * k : 4 * k + 3] = [[-1, -dt, 0], [0, -1, 0], [0, 0, -correlation * sigma / before]]
        step[:, 4 * k + 4 : 4 * k + 7] = np.eye(3)
        rows += [*np.linalg.inv(np.linalg.cholesky(noise)) @ step]
        right += [0.0, 0.0, 0.0]
        measure(k + 1, x, sigma)
        before = sigma
    position, velocity, slow, fast = lstsq(np.stack(rows), np.array(right))[0][-4:]
    expected = torch.tensor([position + 0.2 * velocity, 2.0, 3.0], dtype=torch.float64)
    torch.testing.assert_close(motion.state.predict(stamp + 0.2).position, expected, rtol=0.0, atol=1e-7)
    torch.testing.assert_close(motion.state.velocity, torch.tensor([velocity, 0.0, 0.0], dtype=torch.float64))
    seen = torch.tensor([position + slow + fast, 2.0, 3.0], dtype=torch.float64)
    torch.testing.assert_close(motion.visible_state.position, seen, rtol=0.0, atol=1e-7)


def test_kalman_filter_limits_the_speed() -> None:
    motion = ConstantVelocityKalmanFilter(TrackerConfig(max_speed=2.0))
    for frame in range(10):
        motion.update(0.1 * frame, torch.tensor([0.9, 0.0, 1.2], dtype=torch.float64) * frame, 0.05)
    torch.testing.assert_close(motion.state.velocity, torch.tensor([1.2, 0.0, 1.6], dtype=torch.float64))


class Walk(NamedTuple):
    """A walk that a filter has tracked: the true values at its last measurement, and where the walk is a step later."""

    motion: ConstantVelocityKalmanFilter
    seen: NDArray[np.float64]
    velocity: NDArray[np.float64]
    next_position: NDArray[np.float64]
    next_velocity: NDArray[np.float64]


STEP = 0.1
"""Time between two measurements of a walk, seconds."""


def simulate(generator: np.random.Generator, sigmas: Iterable[float], scale: float = 1.0) -> Walk:
    """Track a walk with white acceleration noise and a changing visible part; `scale` times the assumed noise."""
    motion = ConstantVelocityKalmanFilter(TrackerConfig(max_speed=1e6, acceleration_noise=2.0))
    noise = 2.0**2 * np.array([[STEP**3 / 3, STEP**2 / 2], [STEP**2 / 2, STEP]])
    step, correlation = scale * np.linalg.cholesky(noise), math.exp(-STEP / 2.0)
    position, velocity, part = np.zeros(3), generator.normal(size=3), generator.normal(size=3)
    for k, sigma in enumerate(sigmas):
        fast = math.sqrt(1 - SLOW) * generator.normal(size=3)
        seen = position + scale * sigma * (math.sqrt(SLOW) * part + fast)
        motion.update(k * STEP, torch.from_numpy(seen + scale * NOISE * generator.normal(size=3)), sigma)
        moving, change = velocity, step @ generator.normal(size=(2, 3))
        position, velocity = position + STEP * velocity + change[0], velocity + change[1]
        part = correlation * part + math.sqrt(1 - correlation**2) * generator.normal(size=3)
    return Walk(motion, seen, moving, position, velocity)


def test_covariance_of_the_filter_is_that_of_its_errors() -> None:
    """Monte Carlo: 500 walks into the image, and behind a table."""
    generator, squared, whitened = np.random.default_rng(0), [], []
    sigmas = [0.3, 0.2, *[0.05] * 6, 0.1, 0.2, 0.3, *[0.1] * 4]
    for _ in range(500):
        walk = simulate(generator, sigmas)
        predicted = walk.motion.state.predict(len(sigmas) * STEP)
        error = np.concatenate(
            [predicted.position.numpy() - walk.next_position, predicted.velocity.numpy() - walk.next_velocity]
        )
        squared.append(error @ np.linalg.solve(predicted.covariance.numpy(), error))
        visible = walk.motion.visible_state
        pp, pv, vv = visible.variances
        of_visible = np.stack([visible.position.numpy() - walk.seen, visible.velocity.numpy() - walk.velocity])
        whitened.append(np.linalg.solve(np.linalg.cholesky(np.array([[pp, pv], [pv, vv]])), of_visible))
    low, high = chi2.ppf([0.001, 0.999], 6 * len(squared)) / len(squared)
    assert low < np.mean(squared) < high
    # Whitened errors of position and velocity of the visible part, on the three axes of all walks.
    errors = np.concatenate(whitened, axis=1)
    np.testing.assert_allclose(errors @ errors.T / 1500, np.eye(2), atol=3 * (2 / 1500) ** 0.5)


@pytest.mark.parametrize("scale", [0.3, 1.0, 1.5])
def test_velocity_for_users_is_as_uncertain_as_the_measurements_show(scale: float) -> None:
    """Monte Carlo: 150 walks of 10 s with less noise than the filter assumes, as much, and more."""
    generator = np.random.default_rng(0)
    walks = [simulate(generator, [0.1] * 100, scale) for _ in range(150)]
    states = [walk.motion.visible_state for walk in walks]
    for state in states:
        assert float(torch.linalg.eigvalsh(state.covariance).min()) > 0
    errors = [state.velocity.numpy() - walk.velocity for state, walk in zip(states, walks, strict=True)]
    normalised = [error @ error / state.variances[2] for error, state in zip(errors, states, strict=True)]
    assert np.mean(normalised) / 3 == pytest.approx(1, abs=0.25)
    # The acceleration of the walks is smaller or larger in the same proportion; that of the filter stays.
    assert np.median([state.acceleration_noise for state in states]) == pytest.approx(2.0 * scale, rel=0.15)
    assert {walk.motion.state.acceleration_noise for walk in walks} == {2.0}


@pytest.mark.parametrize(("error", "factor"), [(0.0, 0.05), (2.0, 4.0)])
def test_factor_of_the_variances_is_bounded(error: float, factor: float) -> None:
    """Measurements without noise leave some uncertainty, and masks that jump by metres do not make it endless."""
    motion, generator = ConstantVelocityKalmanFilter(TrackerConfig()), torch.Generator().manual_seed(0)
    for frame in range(600):
        position = error * torch.randn(3, generator=generator, dtype=torch.float64)
        motion.update(frame / 30, position, 0.05)
    assert motion.visible_state.variances[2] == pytest.approx(factor * motion.state.variances[2])


def test_velocity_of_a_part_is_known_sooner_than_the_place_of_the_whole() -> None:
    """A person of whom a quarter is visible walks at 1 m/s: the offset of the part stays, so it hides no motion."""
    motion = ConstantVelocityKalmanFilter(TrackerConfig())
    for frame in range(30):
        motion.update(frame / 30, torch.tensor([0.3 + frame / 30, 0.0, 2.0], dtype=torch.float64), 0.35)
    assert float(motion.state.velocity[0]) == pytest.approx(1.0, abs=0.05)
    assert motion.state.sigmas[1] < 0.7 and motion.state.sigmas[0] > 0.25
    assert float(motion.visible_state.position[0]) == pytest.approx(0.3 + 29 / 30, abs=0.02)
    assert motion.visible_state.sigmas[0] < NOISE


def test_centroid_of_the_surface_replaces_the_visible_position_only() -> None:
    corrected, other = (ConstantVelocityKalmanFilter(TrackerConfig()) for _ in range(2))
    surface = torch.tensor([0.1, 0.2, 2.1], dtype=torch.float64)
    for frame in range(5):
        for motion in (corrected, other):
            motion.update(frame / 30, torch.tensor([frame / 30, 0.0, 2.0], dtype=torch.float64), 0.1)
        before = corrected.visible_state
        assert torch.equal(before.position, other.visible_state.position)
        corrected.correct_visible_position(surface)
        state = corrected.visible_state
        assert torch.equal(state.position, surface) and torch.equal(state.velocity, before.velocity)
        assert torch.equal(corrected.state.position, other.state.position)
        # Position and velocity are as correlated as before, so that the covariance stays positive definite.
        torch.linalg.cholesky(state.covariance)
        correlations = [each.variances[1] / math.prod(each.sigmas) for each in (state, before)]
        assert correlations[0] == pytest.approx(correlations[1])


def make_state() -> ObjectState:
    position, velocity = torch.rand(2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return ObjectState(1.0, position, velocity, (1.0, 0.1, 2.0), 1.5)


def test_state_is_transformed_with_the_world() -> None:
    T = se3_exp(torch.tensor([0.3, -0.1, 0.2, 0.4, 0.5, -0.6], dtype=torch.float64))
    state = make_state()
    later, moved = state.predict(1.7), state.transform(T).predict(1.7)
    torch.testing.assert_close(moved.position, T[:3, :3] @ later.position + T[:3, 3])
    assert moved.variances == later.variances
    assert torch.equal(state.covariance, state.covariance.T) and state.sigmas == (1.0, math.sqrt(2.0))


def test_filter_in_a_corrected_world_goes_on_as_if_it_had_measured_there() -> None:
    T = se3_exp(torch.tensor([0.3, -0.1, 0.2, 0.4, 0.5, -0.6], dtype=torch.float64))
    one, other = (ConstantVelocityKalmanFilter(TrackerConfig()) for _ in range(2))
    points = torch.rand(8, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for k, (point, sigma) in enumerate(zip(points, [0.3, 0.2, 0.1, 0.05, 0.05, 0.1, 0.2, 0.3], strict=True)):
        if k == 5:
            one.apply_world_correction(T)
        one.update(0.1 * k, T[:3, :3] @ point + T[:3, 3] if k >= 5 else point, sigma)
        other.update(0.1 * k, T[:3, :3] @ point + T[:3, 3], sigma)
    for found, expected in ((one.state, other.state), (one.visible_state, other.visible_state)):
        torch.testing.assert_close(found.position, expected.position)
        torch.testing.assert_close(found.velocity, expected.velocity)
        assert found.variances == expected.variances


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


def test_covariance_is_unknown_before_the_first_centroid() -> None:
    motion = ConstantVelocityKalmanFilter(TrackerConfig())
    motion.update(0.1, torch.full((3,), torch.nan, dtype=torch.float64), 0.05)
    state = motion.visible_state
    for later in (state, state.predict(0.4), state.predict_with_decay(9.0, 0.7), state.predict_at_rest(9.0)):
        assert later.position.isnan().all() and later.covariance.isnan().all() and all(map(math.isnan, later.sigmas))
    motion.update(0.2, torch.ones(3, dtype=torch.float64), 0.05)
    assert motion.state.covariance.isfinite().all() and all(map(math.isfinite, motion.state.sigmas))
