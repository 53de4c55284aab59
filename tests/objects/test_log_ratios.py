"""Log-likelihood ratios of positions, masks, appearance, class and vacated places."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.stats import gamma, multivariate_t

from v3d_torch.objects.log_ratios import (
    appearance_log_ratio,
    class_log_ratio,
    overlap_log_ratio,
    position_log_ratio,
    vacated_log_ratio,
)


def test_position_ratio_is_a_t_density_against_new_objects_in_ten_cubic_metres() -> None:
    offset, variance = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64), 0.04
    expected = multivariate_t.logpdf(
        offset.numpy(), shape=[[variance, 0, 0], [0, variance, 0], [0, 0, variance]], df=4
    ) + math.log(10)
    ratio = position_log_ratio(offset.square().sum(), torch.tensor(variance, dtype=torch.float64))
    torch.testing.assert_close(float(ratio), float(expected))


def test_unknown_positions_and_appearances_are_no_evidence() -> None:
    unknown = torch.tensor([torch.nan])
    assert position_log_ratio(unknown, torch.ones(1)).tolist() == [0.0]
    assert appearance_log_ratio(unknown, *map(torch.tensor, (0.1, 400.0, 400.0))).tolist() == [0.0]


def test_mask_of_a_hidden_object_is_no_evidence_against_an_instance() -> None:
    apart = torch.zeros(2, 1, dtype=torch.float64)
    ratio = overlap_log_ratio(apart, apart, torch.tensor([1.0, 0.4], dtype=torch.float64))
    assert ratio.tolist() == [[-3.0], [0.0]]


def test_equal_masks_of_a_visible_object_are_evidence_for_an_instance() -> None:
    equal = torch.ones(1, 1, dtype=torch.float64)
    assert overlap_log_ratio(equal, equal, torch.ones(1, dtype=torch.float64)).tolist() == [[5.0]]


def test_ratio_of_appearance_is_that_of_two_gamma_densities() -> None:
    elapsed, fewer, more = 0.4, 225.0, 450.0
    mean = 0.6 / 15 + 0.05 * elapsed + 0.07 * 0.5
    dissimilarity = torch.tensor([0.02, 0.1, 0.2], dtype=torch.float64)
    same, other = (gamma.logpdf(dissimilarity.numpy(), 2, scale=each / 2) for each in (mean, 0.21))
    ratio = appearance_log_ratio(1 - dissimilarity, *map(torch.tensor, (elapsed, fewer, more)))
    torch.testing.assert_close(ratio, torch.from_numpy(same - other), rtol=1e-6, atol=1e-6)


def test_ratio_of_appearance_increases_with_similarity_and_has_a_lower_bound() -> None:
    ratio = appearance_log_ratio(
        torch.linspace(0, 1, 101, dtype=torch.float64), *map(torch.tensor, (0.1, 400.0, 400.0))
    )
    assert bool((ratio.diff() >= 0).all())
    assert float(ratio[0]) == -3.0


def test_appearance_is_weaker_evidence_after_some_time_and_for_a_small_part() -> None:
    similarity = torch.tensor([0.99, 0.8], dtype=torch.float64)
    soon, later, partial, small = (
        appearance_log_ratio(similarity, *map(torch.tensor, view)).abs()
        for view in ((0.1, 400.0, 400.0), (1.0, 400.0, 400.0), (0.1, 400.0, 900.0), (0.1, 80.0, 80.0))
    )
    assert bool((later < soon).all() and (partial < soon).all() and (small < soon).all())


def test_another_class_and_an_empty_place_are_evidence_against_a_track() -> None:
    assert class_log_ratio(torch.tensor([True, False])).tolist() == [0.0, -2.0]
    assert [vacated_log_ratio(seconds, 1e-4) for seconds in (0.1, 9.0)] == [-3.0, -6.0]


def test_empty_place_is_weak_evidence_against_a_track_of_unknown_velocity() -> None:
    # Most of a normal distribution with a standard deviation of 0.9 m lies outside of the radius of 0.3 m.
    assert vacated_log_ratio(9.0, 0.81) == pytest.approx(-(0.3**2) / (2 * 0.81))
