"""RPE against evo and against the rules of the benchmark's tool; gradients."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from evo.core import metrics
from evo.core.trajectory import PoseTrajectory3D
from helpers.trajectories import assert_statistics, noisy, random_walk
from torch import Tensor

from v3d_torch.errors import ConfigError, InputError
from v3d_torch.evaluation import evaluate
from v3d_torch.evaluation.association import associate_trajectories
from v3d_torch.evaluation.rpe import motion_errors, pairs_apart, relative_errors, relative_pose_error, rpe
from v3d_torch.evaluation.statistics import Statistics
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.types import Trajectory


@pytest.mark.parametrize("seed", range(5))
def test_rpe_equals_evo_on_reversed_time(seed: int) -> None:
    """The benchmark's tool multiplies by the inverse true motion on the right, evo on the left.

    On reversed time both agree. Unlike evo, the tool drops the pairs that end in the last pose.
    """
    groundtruth = random_walk(120, seed)
    estimate = noisy(groundtruth, seed + 100)
    backwards = [
        PoseTrajectory3D(poses_se3=list(t.T_wc[:-1].flip(0).numpy()), timestamps=t.stamps[:-1].numpy())
        for t in (groundtruth, estimate)
    ]
    rpe = evaluate(groundtruth, estimate).rpe
    assert rpe is not None and rpe.pairs == 120 - 1 - 30
    for statistics, relation in (
        (rpe.trans, metrics.PoseRelation.translation_part),
        (rpe.rot, metrics.PoseRelation.rotation_angle_deg),
    ):
        evo_rpe = metrics.RPE(relation, delta=30, delta_unit=metrics.Unit.frames, all_pairs=True)
        evo_rpe.process_data(tuple(backwards))
        assert_statistics(statistics, evo_rpe.get_all_statistics())


def test_rpe_pairs_equal_those_of_benchmark_tool() -> None:
    """Uneven stamps: the pose nearest to one second later, but never the last pose, as a plain loop."""
    generator = np.random.default_rng(5)
    stamps = np.cumsum(generator.uniform(0.02, 0.12, 150))
    expected = []
    for i, stamp in enumerate(stamps):
        j = min(range(len(stamps)), key=lambda k: abs(stamps[k] - (stamp + 1.0)))
        if j != len(stamps) - 1:
            expected.append((i, j))
    first, second = pairs_apart(torch.from_numpy(stamps), 1.0)
    assert list(zip(first.tolist(), second.tolist(), strict=True)) == expected


@pytest.mark.parametrize(("second", "pairs"), [(0.5, [(0, 1)]), (0.625, [(0, 1)]), (0.4375, [])])
def test_convention_rpe_pair_deviates_by_at_most_half_of_delta(second: float, pairs: list[tuple[int, int]]) -> None:
    stamps = torch.tensor([0.0, second, 5.0, 10.0], dtype=torch.float64)
    assert list(zip(*(poses.tolist() for poses in pairs_apart(stamps, 1.0)), strict=True)) == pairs


def test_rpe_default_delta_is_one_second() -> None:
    groundtruth = random_walk(90, seed=16)
    estimate = noisy(groundtruth, seed=17)
    matches = associate_trajectories(groundtruth, estimate)
    by_default = relative_pose_error(groundtruth, estimate, matches)
    assert by_default is not None and by_default.delta == 1.0
    assert by_default == relative_pose_error(groundtruth, estimate, matches, 1.0)
    over_two = relative_pose_error(groundtruth, estimate, matches, 2.0)
    assert over_two is not None and over_two.delta == 2.0 and over_two.pairs == by_default.pairs - 30
    single = motion_errors(groundtruth, estimate, matches)
    assert single.first.tolist() == list(range(by_default.pairs))
    assert Statistics.of(single.trans) == by_default.trans and Statistics.of(single.rot) == by_default.rot
    assert relative_pose_error(groundtruth, estimate, matches, 10.0) is None


def test_rpe_skips_poses_without_ground_truth() -> None:
    """Ground truth from the tenth pose on, so that indices into the two trajectories differ."""
    groundtruth = random_walk(60, seed=18)
    estimate = noisy(groundtruth, seed=19)
    late = Trajectory(groundtruth.stamps[10:], groundtruth.T_wc[10:])
    errors = motion_errors(late, estimate, associate_trajectories(late, estimate), 0.5)
    all_errors = motion_errors(groundtruth, estimate, associate_trajectories(groundtruth, estimate), 0.5)
    assert errors.first.tolist() == [first for first in all_errors.first.tolist() if first >= 10]
    torch.testing.assert_close(errors.trans, all_errors.trans[10:])


def test_rpe_skips_pairs_of_which_one_pose_has_no_ground_truth() -> None:
    """A perfect estimate of 60 poses at 10 Hz; a second of the ground truth is missing."""
    truth = random_walk(60, seed=22, rate=10.0)
    kept = (torch.arange(60) < 25) | (torch.arange(60) >= 35)
    partial, estimate = Trajectory(truth.stamps[kept], truth.T_wc[kept]), noisy(truth, seed=23, sigma=0.0)
    errors = motion_errors(partial, estimate, associate_trajectories(partial, estimate))
    assert errors.first.tolist() == [*range(15), *range(35, 49)]
    assert float(errors.trans.max()) < 1e-9


def test_rpe_pairs_do_not_span_a_gap() -> None:
    """Without a pose one second later there is no pair, neither with itself nor with one three seconds later."""
    stamps = torch.cat([torch.arange(0, 1.05, 0.1), torch.arange(5, 8.05, 0.1)]).double()
    first, second = pairs_apart(stamps, 1.0)
    assert len(first) > 20
    assert ((stamps[second] - stamps[first] - 1).abs() <= 0.5).all()
    assert not (first == second).any()


def test_relative_errors_have_gradients() -> None:
    groundtruth = random_walk(6, seed=20, step=0.3).T_wc
    start = noisy(random_walk(6, seed=20, step=0.3), seed=21, sigma=0.1).T_wc

    def errors(xi: Tensor) -> Tensor:
        T_ec = start @ se3_exp(xi)
        return torch.cat(relative_errors(groundtruth[:-1], groundtruth[1:], T_ec[:-1], T_ec[1:]))

    assert torch.autograd.gradcheck(errors, torch.zeros(6, 6, dtype=torch.float64, requires_grad=True))


def test_rpe_of_a_padded_batch_equals_evaluate() -> None:
    """Trajectories of different lengths; poses without ground truth lie between the others."""
    truths = [random_walk(90, seed=30), random_walk(70, seed=31)]
    estimates = [noisy(truth, seed=33 + k) for k, truth in enumerate(truths)]
    valid = (torch.arange(90) < torch.tensor([[90], [70]])) & (torch.arange(90) % 7 != 3)
    T_gc, T_ec = (torch.full((2, 90, 4, 4), torch.nan, dtype=torch.float64) for _ in range(2))
    stamps = torch.full((2, 90), torch.nan, dtype=torch.float64)
    expected = []
    for k, (truth, estimate) in enumerate(zip(truths, estimates, strict=True)):
        kept, count = valid[k, : len(truth)], len(truth)
        T_gc[k, :count], T_ec[k, :count], stamps[k, :count] = truth.T_wc, estimate.T_wc, truth.stamps
        scores = evaluate(
            Trajectory(truth.stamps[kept], truth.T_wc[kept]), Trajectory(truth.stamps[kept], estimate.T_wc[kept])
        ).rpe
        assert scores is not None
        expected.append((scores.trans.rmse, scores.rot.rmse))
    trans, rot = rpe(T_gc, T_ec, stamps, valid)
    np.testing.assert_allclose(torch.stack([trans, rot], dim=1), expected, rtol=1e-9)
    assert all(each.isnan().all() for each in rpe(T_gc, T_ec, stamps, valid, delta=10.0))


def test_rpe_has_gradients_that_are_finite_for_a_perfect_estimate() -> None:
    truth = random_walk(8, seed=40, step=0.3)
    start = truth.T_wc @ se3_exp(0.1 * torch.sin(torch.arange(48.0, dtype=torch.float64)).reshape(8, 6))

    def errors(xi: Tensor) -> tuple[Tensor, ...]:
        return rpe(truth.T_wc, start @ se3_exp(xi), truth.stamps, delta=2 / 30)

    assert torch.autograd.gradcheck(errors, torch.zeros(8, 6, dtype=torch.float64, requires_grad=True))
    perfect = truth.T_wc.clone().requires_grad_()
    sum(rpe(truth.T_wc, perfect, truth.stamps, delta=2 / 30)).backward()
    assert perfect.grad is not None and perfect.grad.isfinite().all()


@pytest.mark.parametrize("delta", [0.0, -1.0, math.nan])
def test_time_between_poses_that_is_not_positive_is_an_error(delta: float) -> None:
    truth = random_walk(8, seed=41)
    with pytest.raises(ConfigError, match=r"delta is .*; give a number above 0"):
        rpe(truth.T_wc, truth.T_wc, truth.stamps, delta=delta)
    with pytest.raises(ConfigError, match=r"delta is .*; give a number above 0"):
        evaluate(truth, truth, rpe_delta=delta)


def test_stamps_that_do_not_increase_are_an_error() -> None:
    truth = random_walk(8, seed=42)
    unix, valid = (1.3e9 + truth.stamps).to(torch.float32), torch.ones(8, dtype=torch.bool)
    for wrong in (unix, truth.stamps.flip(0), truth.stamps.clone().index_fill_(0, torch.tensor([3]), torch.nan)):
        with pytest.raises(InputError, match=r"^stamps do not increase; .* in float64"):
            rpe(truth.T_wc, truth.T_wc, wrong)
    stamps, valid[3] = truth.stamps.clone(), False
    stamps[3] = -1.0  # padding
    rpe(truth.T_wc, truth.T_wc, stamps, valid)


def test_stamps_too_large_for_the_time_between_poses_give_no_pairs() -> None:
    """Nanoseconds since 1970 as float64 do not change by a second that is added; no pose is paired with itself."""
    truth, estimate = (random_walk(50, seed=seed).T_wc for seed in (42, 43))
    stamps = 1.3e18 + 33_333_333 * torch.arange(50, dtype=torch.float64)
    assert all(each.isnan() for each in rpe(truth, estimate, stamps))
    assert evaluate(Trajectory(stamps, truth), Trajectory(stamps, estimate)).rpe is None
