"""Feature support: objects whose features fit the camera motion as well as the features outside."""

from __future__ import annotations

import pytest
import torch
from helpers.object_scenes import support_without_residuals
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.objects.feature_support import FeatureSupport

HEIGHT, WIDTH = 40, 60


def scene(fitting: float, outside: float = 0.5, count: int = 100) -> tuple[FeatureSupport, Tensor]:
    """Return features and the mask of an object, the left half; a given fraction of either half fits the motion."""
    generator = torch.Generator().manual_seed(0)
    rows = torch.randint(0, HEIGHT, (2 * count,), generator=generator)
    columns = torch.randint(0, WIDTH // 2, (2 * count,), generator=generator)
    columns[count:] += WIDTH // 2
    inlier = torch.zeros(2 * count, dtype=torch.bool)
    inlier[: round(fitting * count)] = True
    inlier[count : count + round(outside * count)] = True
    mask = torch.zeros(1, HEIGHT, WIDTH, dtype=torch.bool)
    mask[:, :, : WIDTH // 2] = True
    return support_without_residuals(torch.stack([columns, rows], dim=1), inlier), mask


@pytest.mark.parametrize(
    ("fitting", "supported"), [(0.5, True), (0.25, True), (0.24, False), (0.0, False), (1.0, True)]
)
def test_object_with_half_the_outside_inlier_ratio_is_supported(fitting: float, supported: bool) -> None:
    support, mask = scene(fitting)
    assert support.supports(support.on_objects(mask)).tolist() == [supported]


@pytest.mark.parametrize(("count", "supported"), [(9, False), (10, True)])
def test_too_few_inliers_support_no_object(count: int, supported: bool) -> None:
    support, mask = scene(1.0, count=count)
    assert support.supports(support.on_objects(mask)).tolist() == [supported]


@pytest.mark.parametrize(("ratio", "supported"), [(0.5, True), (0.25, True), (0.24, False), (0.12, False)])
def test_object_over_the_whole_image_is_compared_with_the_usual_inlier_ratio(ratio: float, supported: bool) -> None:
    support, _ = scene(ratio, outside=ratio)
    everything = torch.ones(1, HEIGHT, WIDTH, dtype=torch.bool)
    assert support.supports(support.on_objects(everything)).tolist() == [supported]


@pytest.mark.parametrize(
    ("fitting", "outside", "count", "has_most"),
    [(0.51, 0.5, 100, True), (0.5, 0.5, 100, False), (1.0, 0.0, 10, True), (1.0, 0.0, 9, False), (0.0, 0.0, 9, False)],
)
def test_object_has_most_inliers_if_more_than_half_are_on_it(
    fitting: float, outside: float, count: int, has_most: bool
) -> None:
    support, mask = scene(fitting, outside, count)
    assert support.have_most_inliers(support.on_objects(mask)).tolist() == [has_most]


def test_no_features_and_no_objects_are_accepted() -> None:
    no_features = support_without_residuals(torch.zeros(0, 2, dtype=torch.int64), torch.zeros(0, dtype=torch.bool))
    everything = torch.ones(2, HEIGHT, WIDTH, dtype=torch.bool)
    assert no_features.supports(no_features.on_objects(everything)).tolist() == [False, False]
    assert no_features.have_most_inliers(no_features.on_objects(everything)).tolist() == [False, False]
    support, _ = scene(0.5)
    assert support.supports(support.on_objects(everything[:0])).shape == (0,)


@given(st.integers(0, 10_000), st.integers(1, 50), st.integers(1, 50), st.integers(0, 30))
def test_features_on_objects_are_those_on_the_pixels_of_their_masks(
    seed: int, height: int, width: int, count: int
) -> None:
    generator = torch.Generator().manual_seed(seed)
    masks = torch.rand(3, height, width, generator=generator) > 0.5
    u, v = (torch.randint(0, size, (count,), generator=generator) for size in (width, height))
    support = support_without_residuals(torch.stack([u, v], dim=1), torch.zeros(count, dtype=torch.bool))
    assert torch.equal(support.on_objects(list(masks)), masks[:, v, u])


@settings(max_examples=30)
@given(st.integers(0, 2**31), st.integers(1, 4), st.floats(0.1, 1.0), st.integers(20, 120))
def test_support_equals_counting_one_by_one(seed: int, objects: int, fitting: float, count: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    masks = torch.rand(objects, HEIGHT, WIDTH, generator=generator) > 0.7
    pixel = torch.stack([torch.randint(0, n, (count,), generator=generator) for n in (WIDTH, HEIGHT)], dim=1)
    on_first = masks[0, pixel[:, 1], pixel[:, 0]]
    inlier = torch.rand(count, generator=generator) < torch.where(on_first, fitting / 2, fitting)
    support = support_without_residuals(pixel, inlier)
    supported_objects = support.supports(support.on_objects(masks))
    outside = [bool(f) for (u, v), f in zip(pixel.tolist(), inlier, strict=True) if not masks[:, v, u].any()]
    outside_ratio = sum(outside) / max(len(outside), 1)
    if len(outside) < 20:  # too few to know the ratio
        outside_ratio = max(outside_ratio, 0.5)
    for mask, supported in zip(masks, supported_objects.tolist(), strict=True):
        inside = [bool(f) for (u, v), f in zip(pixel.tolist(), inlier, strict=True) if mask[v, u]]
        margin = sum(inside) - 0.5 * outside_ratio * len(inside)
        if abs(margin) > 1e-4:
            assert supported == (sum(inside) >= 10 and margin > 0)
