"""Shift of features: objects whose features move together against the camera motion."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.objects.feature_shift import FeatureShift, feature_shifts, sum_shifts

HEIGHT, WIDTH = 120, 160
NOISE = 0.7
"""Standard deviation of a displacement along each axis, pixels."""


def scene(
    seed: int, shift: tuple[float, float], *, bias: float = 0.0, on_object: int = 40
) -> list[FeatureShift | None]:
    """Shift of an object in the middle of an image: its features are displaced by ``shift``, all others by ``bias``."""
    generator = torch.Generator().manual_seed(seed)
    rows, columns = (torch.randint(0, size, (900,), generator=generator) for size in (HEIGHT, WIDTH))
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[40:80, 60:100] = True
    inside = mask[rows, columns]
    kept = ~inside | (inside.cumsum(dim=0) <= on_object)
    pixel, inside = torch.stack([columns, rows], dim=1)[kept], inside[kept]
    residuals = NOISE * torch.randn(len(pixel), 2, generator=generator, dtype=torch.float64)
    residuals[:, 0] += bias
    residuals[inside] += torch.tensor(shift, dtype=torch.float64)
    residuals[::3] = torch.nan  # not matched
    wrong = torch.rand(len(pixel), generator=generator) < 0.2
    residuals[wrong] = 30 * torch.randn(int(wrong.sum()), 2, generator=generator, dtype=torch.float64)
    return feature_shifts(pixel, residuals, inside[None], mask.shape)


def total(frames: int, shift: tuple[float, float], **settings: float) -> FeatureShift:
    """Sum of the shifts of some frames."""
    shifts = [scene(seed, shift, **settings)[0] for seed in range(frames)]  # type: ignore[arg-type]
    return sum_shifts(each for each in shifts if each is not None)


def test_slow_motion_of_some_frames_is_found_and_that_of_a_frame_is_not() -> None:
    (shift,) = scene(0, (0.8, -0.6))
    assert shift is not None and not shift.is_motion
    summed = total(9, (0.8, -0.6))
    assert summed.is_motion
    assert summed.pixels == pytest.approx((7.2, -5.4), abs=4 * math.sqrt(summed.variance))


@pytest.mark.parametrize("bias", [0.0, 1.0])
def test_object_that_is_displaced_like_everything_else_stands_still(bias: float) -> None:
    assert not total(9, (0.0, 0.0), bias=bias).is_motion


def test_motion_beyond_the_displacement_elsewhere_is_found() -> None:
    assert total(9, (1.5, 0.0), bias=0.5).is_motion


def test_displacements_elsewhere_in_changing_directions_do_not_hide_a_motion() -> None:
    shifts = [scene(seed, (0.8, 0.0), bias=0.6 * (-1) ** seed)[0] for seed in range(9)]
    known = [each for each in shifts if each is not None]
    assert sum_shifts(known).is_motion
    in_one_direction = sum(float(each.elsewhere.norm(dim=1).nanmedian()) for each in known)
    assert float(sum_shifts(known).elsewhere.norm(dim=1).nanmedian()) < in_one_direction / 3


def test_cell_that_is_known_in_some_frames_has_its_mean_in_the_others() -> None:
    first, second = torch.tensor([[1.0, 2.0], [3.0, 0.0]]), torch.tensor([[2.0, 2.0], [torch.nan, torch.nan]])
    summed = sum_shifts(FeatureShift((1.0, 0.0), 0.5, each) for each in (first, second))
    assert summed.pixels == (2.0, 0.0) and summed.variance == 1.0
    assert summed.elsewhere.tolist() == [[3.0, 4.0], [6.0, 0.0]]


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6))
def test_noise_is_no_motion(seed: int) -> None:
    shifts = [scene(seed + k, (0.0, 0.0))[0] for k in range(9)]
    assert not sum_shifts(each for each in shifts if each is not None).is_motion


def test_variance_is_that_of_the_median() -> None:
    shifts = [each for k in range(60) if (each := scene(k, (0.0, 0.0))[0]) is not None]
    scatter = torch.tensor([each.pixels for each in shifts]).square().sum(dim=1).mean()
    variance = sum(each.variance for each in shifts) / len(shifts)
    assert 0.5 < variance / float(scatter) < 1.5  # the median of normally distributed values varies by pi / 2 more


def test_shift_of_few_features_is_unknown() -> None:
    assert scene(0, (9.0, 0.0), on_object=8) == [None]
    for objects in (0, 1):
        on_objects = torch.ones(objects, 0, dtype=torch.bool)
        shifts = feature_shifts(torch.zeros(0, 2).long(), torch.zeros(0, 2).double(), on_objects, (4, 4))
        assert shifts == objects * [None]


def test_nothing_is_known_without_other_places() -> None:
    """The object fills the image."""
    pixel = torch.stack([torch.arange(100), torch.arange(100)], dim=1)
    residuals = torch.full((100, 2), 9.0, dtype=torch.float64)
    (shift,) = feature_shifts(pixel, residuals, torch.ones(1, 100, dtype=torch.bool), (HEIGHT, WIDTH))
    assert shift is not None and bool(shift.elsewhere.isnan().all()) and not shift.is_motion


def displaced(masks: list[Tensor]) -> list[FeatureShift | None]:
    pixel = torch.cartesian_prod(torch.arange(0, WIDTH, 4), torch.arange(0, HEIGHT, 4))
    residuals = torch.zeros(len(pixel), 2, dtype=torch.float64)
    on_objects = torch.stack([mask[pixel[:, 1], pixel[:, 0]] for mask in masks])
    residuals[on_objects[1]] = 5.0
    return feature_shifts(pixel, residuals, on_objects, (HEIGHT, WIDTH))


def test_shifts_are_in_the_order_of_the_masks() -> None:
    left, right, empty = (torch.zeros(HEIGHT, WIDTH, dtype=torch.bool) for _ in range(3))
    left[30:90, 10:60], right[30:90, 90:140] = True, True
    still, moving, unknown = displaced([left, right, empty])
    assert still is not None and not still.is_motion
    assert moving is not None and moving.is_motion and moving.pixels == (5.0, 5.0)
    assert unknown is None
