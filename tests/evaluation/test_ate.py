"""ATE against evo; alignment in regular and degenerate cases; scale errors; gradients."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from evo.core import metrics
from evo.core.trajectory import PoseTrajectory3D
from helpers.trajectories import assert_statistics, noisy, random_walk
from scipy.spatial.transform import Rotation
from torch import Tensor

from v3d_torch.evaluation import evaluate
from v3d_torch.evaluation.ate import RotationSource, absolute_errors, align, ate, scale_error, spans_plane
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.types import Trajectory


def to_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    return PoseTrajectory3D(poses_se3=list(trajectory.T_wc.numpy()), timestamps=trajectory.stamps.numpy())


@pytest.mark.parametrize("seed", range(5))
def test_ate_equals_evo(seed: int) -> None:
    groundtruth = random_walk(200, seed)
    estimate = noisy(groundtruth, seed + 100)
    reference, aligned = to_evo(groundtruth), copy.deepcopy(to_evo(estimate))
    R, t, _ = aligned.align(reference)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, aligned))
    evaluation = evaluate(groundtruth, estimate)
    assert_statistics(evaluation.ate, ape.get_all_statistics())
    np.testing.assert_allclose(evaluation.alignment.T_ge[:3, :3].numpy(), R, atol=1e-9)
    np.testing.assert_allclose(evaluation.alignment.T_ge[:3, 3].numpy(), t, atol=1e-9)


def test_convention_alignment_maps_estimate_to_ground_truth() -> None:
    groundtruth = random_walk(50, seed=6)
    estimate = noisy(groundtruth, seed=7, sigma=0.0)
    evaluation = evaluate(groundtruth, estimate)
    assert torch.allclose(evaluation.alignment.T_ge @ estimate.T_wc, groundtruth.T_wc, atol=1e-12)
    assert evaluation.ate.max < 1e-12
    assert evaluation.alignment.source is RotationSource.POSITIONS and not evaluation.notes


def test_alignment_keeps_scale_of_estimate() -> None:
    groundtruth = random_walk(50, seed=6)
    T_wc = groundtruth.T_wc.clone()
    T_wc[:, :3, 3] *= 1.1
    p = groundtruth.T_wc[:, :3, 3]
    spread = (p - p.mean(dim=0)).square().sum(dim=1).mean().sqrt().item()
    assert evaluate(groundtruth, Trajectory(groundtruth.stamps, T_wc)).ate.rmse == pytest.approx(0.1 * spread)


def test_alignment_of_mirrored_estimate_is_a_rotation() -> None:
    groundtruth = random_walk(50, seed=8)
    T_wc = groundtruth.T_wc.clone()
    T_wc[:, 0, 3] *= -1
    evaluation = evaluate(groundtruth, Trajectory(groundtruth.stamps, T_wc))
    assert torch.linalg.det(evaluation.alignment.T_ge).item() == pytest.approx(1)
    assert evaluation.ate.rmse > 0.01


@pytest.mark.parametrize("direction", [(0.0, 0.0, 0.0), (1.0, 2.0, -1.0)])
def test_alignment_of_positions_on_point_or_line_uses_orientations(direction: tuple[float, float, float]) -> None:
    """The camera only turns, or moves along a line. Orientations give the true rotation, positions do not."""
    groundtruth = random_walk(90, seed=9)
    on_line = torch.linspace(0, 1, 90, dtype=torch.float64)[:, None] * torch.tensor(direction, dtype=torch.float64)
    T_wc = groundtruth.T_wc.clone()
    T_wc[:, :3, 3] = on_line
    groundtruth = Trajectory(groundtruth.stamps, T_wc)
    estimate = noisy(groundtruth, seed=10, sigma=1e-3)
    evaluation = evaluate(groundtruth, estimate)
    assert evaluation.alignment.source is RotationSource.ORIENTATIONS
    assert any("do not span a plane" in note for note in evaluation.notes)
    misaligned = Rotation.from_matrix((evaluation.alignment.T_ge @ estimate.T_wc @ invert(T_wc))[:, :3, :3].numpy())
    assert misaligned.magnitude().mean() < 5e-3
    by_positions = align(T_wc, estimate.T_wc, oriented=False)
    misaligned = Rotation.from_matrix((by_positions.T_ge @ estimate.T_wc @ invert(T_wc))[:, :3, :3].numpy())
    assert misaligned.magnitude().mean() > 0.1
    aligned = (evaluation.alignment.T_ge @ estimate.T_wc)[:, :3, 3]
    assert torch.allclose(aligned.mean(dim=0), T_wc[:, :3, 3].mean(dim=0), atol=1e-12)


@pytest.mark.parametrize("count", [4, 400])
def test_convention_positions_span_plane_from_one_millimetre(count: int) -> None:
    """By the second largest of the standard deviations along the axes."""
    corners = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=torch.float64)
    corners = corners.repeat(count // 4, 1) + 5
    for spread, plane in (([1, 1.01e-3, 0], True), ([1, 0.99e-3, 0.99e-3], False), ([0, 1.01e-3, 1.01e-3], True)):
        assert bool(spans_plane(corners * torch.tensor(spread, dtype=torch.float64))) is plane


@pytest.mark.parametrize(("size", "is_error"), [(1.49, False), (1.51, True), (1 / 1.49, False), (1 / 1.51, True)])
def test_convention_scale_error_starts_at_factor_of_one_and_a_half(size: float, is_error: bool) -> None:
    truth = random_walk(40, seed=20).T_wc
    estimate = truth.clone()
    estimate[:, :3, 3] /= size
    factor = scale_error(truth, estimate, align(truth, estimate))
    assert factor == (pytest.approx(size) if is_error else None)


@pytest.mark.parametrize(("spread", "is_error"), [(0.051, True), (0.049, False)])
def test_convention_scale_error_requires_positions_that_spread_by_5_cm(spread: float, is_error: bool) -> None:
    """By the root mean square distance of the true positions from their mean."""
    truth = random_walk(40, seed=20).T_wc
    centred = truth[:, :3, 3] - truth[:, :3, 3].mean(dim=0)
    truth[:, :3, 3] = centred * spread / centred.square().sum(dim=1).mean().sqrt()
    estimate = truth.clone()
    estimate[:, :3, 3] *= 2
    factor = scale_error(truth, estimate, align(truth, estimate))
    assert factor == (pytest.approx(0.5) if is_error else None)


def test_scale_error_requires_three_quarters_of_variance_explained() -> None:
    """The estimate has noise, relative to the signal, across the direction of motion."""
    truth = torch.eye(4, dtype=torch.float64).repeat(4, 1, 1)
    truth[:, 0, 3] = torch.tensor([1.0, -1, 1, -1])
    for noise, is_error in ((0.55, True), (0.6, False)):  # unexplained: noise^2 / (1 + noise^2), a quarter at 0.577
        estimate = truth.clone()
        estimate[:, 1, 3] = noise * torch.tensor([1.0, 1, -1, -1])
        estimate[:, :3, 3] /= 3
        alignment = align(truth, truth)._replace(T_ge=torch.eye(4, dtype=torch.float64))
        assert (scale_error(truth, estimate, alignment) is not None) is is_error


def test_motion_in_the_opposite_direction_is_no_scale_error() -> None:
    """The orientations determine the rotation, so that the factor between the positions is negative."""
    truth = torch.eye(4, dtype=torch.float64).repeat(20, 1, 1)
    truth[:, 0, 3] = torch.arange(20)
    estimate = truth.clone()
    estimate[:, 0, 3] *= -1
    assert scale_error(truth, estimate, align(truth, estimate)) is None


@pytest.mark.parametrize("size", [0.0, 1.0], ids=["only turns", "moves"])
def test_alignment_ignores_padding_of_any_value(size: float) -> None:
    truth = random_walk(40, seed=13)
    truth.T_wc[:, :3, 3] *= size
    T_gc, T_ec = truth.T_wc, noisy(truth, seed=14).T_wc
    padded = [torch.cat([T, random_walk(15, seed).T_wc]) for seed, T in ((15, T_gc), (16, T_ec))]
    torch.testing.assert_close(align(*padded, torch.arange(55) < 40).T_ge, align(T_gc, T_ec).T_ge)


def test_mean_orientation_equals_scipy() -> None:
    groundtruth = random_walk(40, seed=11)
    groundtruth.T_wc[:, :3, 3] = 0
    estimate = noisy(groundtruth, seed=12, sigma=0.3)
    between = groundtruth.T_wc[:, :3, :3] @ estimate.T_wc[:, :3, :3].mT
    expected = Rotation.from_matrix(between.numpy()).mean().as_matrix()
    np.testing.assert_allclose(align(groundtruth.T_wc, estimate.T_wc).T_ge[:3, :3].numpy(), expected, atol=1e-9)


def test_absolute_errors_have_gradients() -> None:
    groundtruth = random_walk(6, seed=20, step=0.3).T_wc
    start = noisy(random_walk(6, seed=20, step=0.3), seed=21, sigma=0.1).T_wc

    def errors(xi: Tensor) -> Tensor:
        T_ec = start @ se3_exp(xi)
        return absolute_errors(groundtruth, T_ec, align(groundtruth, T_ec))

    assert torch.autograd.gradcheck(errors, torch.zeros(6, 6, dtype=torch.float64, requires_grad=True))


def test_ate_of_a_padded_batch_equals_evaluate() -> None:
    """Trajectories of different lengths, one of a camera that only turns."""
    truths = [random_walk(60, seed=30), random_walk(40, seed=31), random_walk(50, seed=32)]
    truths[1].T_wc[:, :3, 3] = 0
    estimates = [noisy(truth, seed=33 + k) for k, truth in enumerate(truths)]
    valid = torch.arange(60) < torch.tensor([[60], [40], [50]])
    T_gc, T_ec = (torch.full((3, 60, 4, 4), torch.nan, dtype=torch.float64) for _ in range(2))
    for k, (truth, estimate) in enumerate(zip(truths, estimates, strict=True)):
        T_gc[k, : len(truth)], T_ec[k, : len(truth)] = truth.T_wc, estimate.T_wc
    expected = [evaluate(truth, estimate).ate.rmse for truth, estimate in zip(truths, estimates, strict=True)]
    np.testing.assert_allclose(ate(T_gc, T_ec, valid), expected, rtol=1e-9)
    assert ate(T_gc[0].float(), T_ec[0].float()).dtype == torch.float32
    assert ate(T_gc[:0], T_ec[:0]).shape == (0,) and ate(T_gc[:, :0], T_ec[:, :0]).isnan().all()


def test_ate_has_gradients_that_are_finite_for_a_perfect_estimate() -> None:
    truth = torch.stack([random_walk(6, seed=40, step=0.3).T_wc, random_walk(6, seed=41, step=0.3).T_wc])
    start = truth @ se3_exp(0.1 * torch.sin(torch.arange(72.0, dtype=torch.float64)).reshape(2, 6, 6))

    def errors(xi: Tensor) -> Tensor:
        return ate(truth, start @ se3_exp(xi))

    assert torch.autograd.gradcheck(errors, torch.zeros(2, 6, 6, dtype=torch.float64, requires_grad=True))
    perfect = truth.clone().requires_grad_()
    ate(truth, perfect).sum().backward()
    assert perfect.grad is not None and perfect.grad.isfinite().all()


def test_trajectory_that_is_not_finite_does_not_affect_the_others_of_a_batch() -> None:
    truth = random_walk(20, seed=50)
    T_gc, T_ec = truth.T_wc, noisy(truth, seed=51).T_wc
    expected = torch.stack([ate(T_gc, T_ec), T_ec.new_tensor(torch.nan)])
    lost = torch.full_like(T_ec, torch.nan)
    torch.testing.assert_close(ate(torch.stack([T_gc, T_gc]), torch.stack([T_ec, lost])), expected, equal_nan=True)
    torch.testing.assert_close(ate(torch.stack([T_gc, lost]), torch.stack([T_ec, T_ec])), expected, equal_nan=True)
