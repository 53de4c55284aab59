"""The features' word: an object whose features fit the camera's motion as well as the rest's stands still."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.objects.feature_support import FeatureSupport

HEIGHT, WIDTH = 40, 60


def scene(fitting: float, outside: float = 0.5, count: int = 100) -> tuple[FeatureSupport, Tensor]:
    """So many features on the left half, an object, and on the right; of each half a share fits."""
    generator = torch.Generator().manual_seed(0)
    rows = torch.randint(0, HEIGHT, (2 * count,), generator=generator)
    columns = torch.randint(0, WIDTH // 2, (2 * count,), generator=generator)
    columns[count:] += WIDTH // 2
    fits = torch.zeros(2 * count, dtype=torch.bool)
    fits[: round(fitting * count)] = True
    fits[count : count + round(outside * count)] = True
    mask = torch.zeros(1, HEIGHT, WIDTH, dtype=torch.bool)
    mask[:, :, : WIDTH // 2] = True
    return FeatureSupport(torch.stack([columns, rows], dim=1), fits), mask


@pytest.mark.parametrize(("fitting", "vouched"), [(0.5, True), (0.25, True), (0.24, False), (0.0, False), (1.0, True)])
def test_half_as_many_as_elsewhere_are_enough(fitting: float, vouched: bool) -> None:
    witnesses, mask = scene(fitting)
    assert witnesses.supports(mask, 0.5, 10).tolist() == [vouched]


@pytest.mark.parametrize(("count", "vouched"), [(9, False), (10, True)])
def test_too_few_vouch_for_nobody(count: int, vouched: bool) -> None:
    witnesses, mask = scene(1.0, count=count)
    assert witnesses.supports(mask, 0.5, 10).tolist() == [vouched]


def test_an_object_over_the_whole_image_has_nothing_to_compare_with() -> None:
    """What fits then fits a motion that is the object's own: by the number alone."""
    witnesses, _ = scene(0.5)
    everything = torch.ones(1, HEIGHT, WIDTH, dtype=torch.bool)
    assert witnesses.supports(everything, 0.5, 10).tolist() == [True]


def test_no_features_and_no_objects() -> None:
    nobody = FeatureSupport(torch.zeros(0, 2, dtype=torch.int64), torch.zeros(0, dtype=torch.bool))
    assert nobody.supports(torch.ones(2, HEIGHT, WIDTH, dtype=torch.bool), 0.5, 10).tolist() == [False, False]
    witnesses, _ = scene(0.5)
    assert witnesses.supports(torch.zeros(0, HEIGHT, WIDTH, dtype=torch.bool), 0.5, 10).shape == (0,)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 4), st.floats(0.1, 1.0), st.integers(1, 8))
def test_same_as_counting_one_by_one(seed: int, objects: int, share: float, least: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    masks = torch.rand(objects, HEIGHT, WIDTH, generator=generator) > 0.7
    pixel = torch.stack([torch.randint(0, n, (60,), generator=generator) for n in (WIDTH, HEIGHT)], dim=1)
    fits = torch.rand(60, generator=generator) > 0.5
    told = FeatureSupport(pixel, fits).supports(masks, share, least)
    elsewhere = [bool(f) for (u, v), f in zip(pixel.tolist(), fits, strict=True) if not masks[:, v, u].any()]
    usual = sum(elsewhere) / max(len(elsewhere), 1)
    for mask, vouched in zip(masks, told.tolist(), strict=True):
        there = [bool(f) for (u, v), f in zip(pixel.tolist(), fits, strict=True) if mask[v, u]]
        margin = sum(there) - share * usual * len(there)
        if abs(margin) > 1e-4:
            assert vouched == (sum(there) >= least and margin > 0)
