"""Log-likelihood ratios of positions, masks, appearance, class and vacancy."""

from __future__ import annotations

import math

import torch
from scipy.stats import multivariate_t

from v3d_torch.objects.association import (
    appearance_log_ratio,
    class_log_ratio,
    overlap_log_ratio,
    position_log_ratio,
    vacancy_log_ratio,
)


def test_position_ratio_is_a_t_density_against_new_objects_in_ten_cubic_metres() -> None:
    offset, variance = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64), 0.04
    expected = multivariate_t.logpdf(
        offset.numpy(), shape=[[variance, 0, 0], [0, variance, 0], [0, 0, variance]], df=4
    ) + math.log(10)
    ratio = position_log_ratio(offset.square().sum(), torch.tensor(variance, dtype=torch.float64))
    torch.testing.assert_close(float(ratio), float(expected))


def test_unknown_positions_and_appearances_say_nothing() -> None:
    unknown = torch.tensor([torch.nan])
    assert position_log_ratio(unknown, torch.ones(1)).tolist() == [0.0]
    assert appearance_log_ratio(unknown).tolist() == [0.0]


def test_mask_of_a_hidden_object_speaks_against_no_instance() -> None:
    apart = torch.zeros(2, 1, dtype=torch.float64)
    ratio = overlap_log_ratio(apart, apart, torch.tensor([1.0, 0.4], dtype=torch.float64))
    assert ratio.tolist() == [[-3.0], [0.0]]


def test_equal_masks_of_a_visible_object_speak_for_an_instance() -> None:
    equal = torch.ones(1, 1, dtype=torch.float64)
    assert overlap_log_ratio(equal, equal, torch.ones(1, dtype=torch.float64)).tolist() == [[5.0]]


def test_ratio_of_appearance_increases_with_similarity_within_bounds() -> None:
    ratio = appearance_log_ratio(torch.linspace(0, 1, 101, dtype=torch.float64))
    assert bool((ratio.diff() >= 0).all())
    assert (float(ratio[0]), float(ratio[-1])) == (-4.0, 1.5)


def test_another_class_and_an_empty_place_speak_against_a_track() -> None:
    assert class_log_ratio(torch.tensor([True, False])).tolist() == [0.0, -2.0]
    torch.testing.assert_close(vacancy_log_ratio(torch.tensor([0.0, 0.1, 9.0])), torch.tensor([0.0, -3.0, -6.0]))
