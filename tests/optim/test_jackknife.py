"""Jackknife covariance against leaving data out, and against the scatter of estimates."""

from __future__ import annotations

import math

import pytest
import scipy.stats
import torch
from torch import Tensor

from v3d_torch.optim.jackknife import jackknife_covariance, p_value


def make_groups(groups: int, seed: int, common: float = 0.0, size: int = 20) -> tuple[Tensor, Tensor]:
    """Derivatives of the squared errors of a linear regression, at 0, for groups with a common error.

    Args:
        groups: Number of groups.
        seed: Seed of the data.
        common: Standard deviation of the error that all measurements of a group share; that of their own is 1.
        size: Number of measurements of a group.
    """
    generator = torch.Generator().manual_seed(seed)
    A = 1 + torch.randn(groups, size, 2, generator=generator, dtype=torch.float64)
    error = torch.randn(groups, size, generator=generator, dtype=torch.float64)
    shared = common * torch.randn(groups, 1, generator=generator, dtype=torch.float64)
    b = A @ torch.tensor([0.5, -2.0], dtype=torch.float64) + error + shared
    return -2 * (A.mT @ b[..., None])[..., 0], 2 * A.mT @ A


def covariance_of(gradient: Tensor, hessian: Tensor) -> Tensor:
    return jackknife_covariance(gradient, hessian).covariance


def minimum(gradient: Tensor, hessian: Tensor) -> Tensor:
    return torch.linalg.solve(hessian.sum(dim=0), -gradient.sum(dim=0))


def leave_one_of_eight_out(gradient: Tensor, hessian: Tensor) -> Tensor:
    """Return the covariance from the minima without one of eight groups, with the factor for two parameters."""
    without = torch.stack([minimum(gradient[torch.arange(8) != k], hessian[torch.arange(8) != k]) for k in range(8)])
    change = without - minimum(gradient, hessian)
    return 7 / 8 * (change.T @ change) * 7 / 5


def test_covariance_equals_that_of_minima_without_one_group() -> None:
    groups = make_groups(8, seed=1)
    torch.testing.assert_close(covariance_of(*groups), leave_one_of_eight_out(*groups))


def test_covariance_does_not_depend_on_the_point_of_linearisation() -> None:
    gradient, hessian = make_groups(8, seed=2)
    moved = gradient + hessian @ torch.tensor([3.0, -1.0], dtype=torch.float64)
    torch.testing.assert_close(covariance_of(moved, hessian), covariance_of(gradient, hessian))


@pytest.mark.parametrize("common", [0.0, 2.0])
def test_errors_agree_with_the_covariance_although_groups_have_common_errors(common: float) -> None:
    true = torch.tensor([0.5, -2.0], dtype=torch.float64)
    jackknife, inverse = [], []
    for seed in range(200):
        gradient, hessian = make_groups(10, seed, common)
        error = minimum(gradient, hessian) - true
        jackknife.append(float(error @ torch.linalg.solve(covariance_of(gradient, hessian), error)) / 2)
        inverse.append(float(error @ (hessian.sum(dim=0) / 2) @ error) / 2)
    assert 0.6 < sum(jackknife) / len(jackknife) < 1.6
    assert (sum(inverse) / len(inverse) > 5) is (common > 0)


def test_successive_groups_are_merged_to_ten_blocks() -> None:
    gradient, hessian = make_groups(40, seed=3)
    blocks = [each.unflatten(0, (10, 4)).sum(dim=1) for each in (gradient, hessian)]
    torch.testing.assert_close(covariance_of(gradient, hessian), covariance_of(*blocks))


def test_covariance_is_infinite_for_few_groups_or_if_one_has_all_information() -> None:
    gradient, hessian = make_groups(3, seed=4)
    assert covariance_of(gradient, hessian).isinf().all()
    gradient, hessian = make_groups(6, seed=4)
    hessian[1:, 1, :], hessian[1:, :, 1] = 0.0, 0.0
    assert covariance_of(gradient, hessian).isinf().all()


def test_groups_without_information_do_not_count() -> None:
    gradient, hessian = make_groups(6, seed=5)
    with_empty = [torch.cat([each, torch.zeros_like(each[:3])]) for each in (gradient, hessian)]
    torch.testing.assert_close(covariance_of(*with_empty), covariance_of(gradient, hessian))


def test_groups_with_information_on_some_parameters_count() -> None:
    gradient, hessian = make_groups(8, seed=6)
    hessian = hessian * torch.eye(2)
    gradient[1::2, 1], hessian[1::2, 1, 1] = 0.0, 0.0
    torch.testing.assert_close(covariance_of(gradient, hessian), leave_one_of_eight_out(gradient, hessian))


def one(value: float) -> Tensor:
    return torch.tensor([[value]], dtype=torch.float64)


@pytest.mark.parametrize("blocks", [4, 6, 10])
@pytest.mark.parametrize("difference", [0.0, 0.5, 3.3, -8.0])
def test_p_value_of_one_parameter_is_that_of_a_t_test(difference: float, blocks: int) -> None:
    # The covariance of the jackknife includes the variance of the t-distribution.
    freedom = blocks - 1
    expected = 2 * scipy.stats.t.sf(abs(difference) / 2.0, freedom)
    found = p_value(one(difference)[0], one(4.0 * freedom / (freedom - 2)), one(0.0), blocks)
    assert found == pytest.approx(expected, rel=1e-9)


def test_p_value_of_known_errors_is_that_of_a_chi_squared_test() -> None:
    known, difference = torch.diag(torch.tensor([1.0, 4.0])).double(), torch.tensor([2.0, -5.0]).double()
    expected = scipy.stats.chi2.sf(4.0 + 25.0 / 4.0, 2)
    assert p_value(difference, torch.zeros_like(known), known, 10) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(("known", "groups"), [(0.0, 10), (0.02, 10), (0.2, 10), (0.0, 5), (0.2, 5)])
def test_p_values_of_true_parameters_are_uniform(known: float, groups: int) -> None:
    """If nothing is known, a chi-squared test calls ten times as many significant at a level of 0.001."""
    true, generator = torch.tensor([0.5, -2.0], dtype=torch.float64), torch.Generator().manual_seed(0)
    values = []
    for seed in range(600):
        gradient, hessian = make_groups(groups, seed, common=2.0)
        other = known**0.5 * torch.randn(2, generator=generator, dtype=torch.float64)
        error = minimum(gradient, hessian) - true + other
        jackknife = jackknife_covariance(gradient, hessian)
        values.append(p_value(error, jackknife.covariance, known * torch.eye(2).double(), jackknife.blocks))
    for level in (0.01, 0.05, 0.5):
        assert sum(value < level for value in values) / len(values) == pytest.approx(level, abs=0.3 * level + 0.01)


@pytest.mark.parametrize("groups", [4, 5, 6])
def test_p_value_is_one_if_the_blocks_are_too_few_for_the_parameters(groups: int) -> None:
    """Their covariance is singular: in some direction every difference would be significant, and in others NaN."""
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        factors = torch.randn(groups, 40, 6, generator=generator, dtype=torch.float64)
        errors = torch.randn(groups, 40, generator=generator, dtype=torch.float64)
        gradient = torch.einsum("kn,kni->ki", errors, factors)
        hessian = torch.einsum("kni,knj->kij", factors, factors)
        jackknife = jackknife_covariance(gradient, hessian)
        assert jackknife.covariance.isfinite().all()
        difference = minimum(gradient, hessian)
        assert p_value(difference, jackknife.covariance, torch.zeros(6, 6).double(), jackknife.blocks) == 1.0


@pytest.mark.parametrize(("groups", "blocks"), [(3, 3), (5, 5), (10, 10), (25, 10)])
def test_number_of_blocks_is_returned(groups: int, blocks: int) -> None:
    gradient, hessian = make_groups(groups, seed=7)
    assert jackknife_covariance(gradient, hessian).blocks == blocks
    with_empty = [torch.cat([each, torch.zeros_like(each[:3])]) for each in (gradient, hessian)]
    assert jackknife_covariance(*with_empty).blocks == blocks


@pytest.mark.parametrize(
    ("difference", "variance", "blocks"), [(torch.nan, 1.0, 10), (1.0, torch.inf, 3), (1.0, torch.inf, 1)]
)
def test_p_value_of_an_unknown_difference_is_not_a_number(difference: float, variance: float, blocks: int) -> None:
    assert math.isnan(p_value(one(difference)[0], one(variance), one(0.0), blocks))
