"""Conversion of depth to metres."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from v3d_torch.errors import InputError
from v3d_torch.geometry.depth_units import depth_to_metres, depth_to_units, implausible_median


def test_convention_depth_in_metres_is_units_divided_by_the_depth_scale() -> None:
    units = np.array([[0, 1, 5000, 65534, 65535]], np.uint16)
    metres = depth_to_metres(units, 5000)
    assert metres.dtype == torch.float32 and metres.shape == (1, 1, 5)
    np.testing.assert_allclose(metres[0, 0], [0, 0.0002, 1, 13.1068, 0], rtol=1e-6)


@pytest.mark.parametrize("dtype", [np.int16, np.int32, np.uint32, np.int64, ">u2", ">i4"])
def test_whole_numbers_of_every_type_are_converted(dtype: object) -> None:
    units = np.array([[0, 700, 30000]]).astype(dtype)
    np.testing.assert_allclose(depth_to_metres(units, 1000)[0, 0], [0, 0.7, 30.0], rtol=1e-6)


def test_large_values_are_depth_in_types_of_more_than_16_bits() -> None:
    np.testing.assert_allclose(depth_to_metres(np.array([[65535, 200000]], np.int32), 10000)[0, 0], [6.5535, 20.0])


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, ">f4"])
def test_floating_point_is_in_metres_whatever_the_depth_scale(dtype: object) -> None:
    metres = np.array([[0.5, -1.0, np.nan, np.inf, -np.inf, 0.0]]).astype(dtype)
    for scale in (None, 5000.0):
        assert depth_to_metres(metres, scale).tolist() == [[[0.5, 0, 0, 0, 0, 0]]]


def test_sky_of_a_renderer_is_no_measurement() -> None:
    with np.errstate(all="raise"):
        assert depth_to_metres(np.array([[1e10, 65504.0, 1e300, 9.5]]), None).tolist() == [[[0, 0, 0, 9.5]]]


def test_conversion_to_units_and_back_gives_the_depth_and_beyond_sixteen_bits_nothing() -> None:
    depth = torch.tensor([[[0.0, 0.001, 0.0016, 65.534, 65.535, 1e4]]])
    units, out_of_range = depth_to_units(depth, 1000)
    assert units.dtype == np.uint16 and units.tolist() == [[0, 1, 2, 65534, 0, 0]] and out_of_range == 2
    assert torch.allclose(depth_to_metres(units, 1000), torch.tensor([[[0.0, 0.001, 0.002, 65.534, 0.0, 0.0]]]))


def test_result_does_not_share_memory() -> None:
    for image in (np.ones((2, 2), np.float32), np.ones((2, 2), np.uint16)):
        metres = depth_to_metres(image, 1.0)
        image[:] = 7
        assert bool((metres == 1).all())


def test_whole_numbers_without_a_depth_scale_are_rejected() -> None:
    with pytest.raises(InputError, match="give the camera a depth_scale"):
        depth_to_metres(np.ones((2, 2), np.uint16), None)


@pytest.mark.parametrize(
    ("depth", "expected"),
    [([0.0], None), ([0.04, 0.04, 9.0], 0.04), ([0.0, 0.0, 0.06], None), ([49.0], None), ([0.0, 51.0], 51.0)],
)
def test_median_of_the_measured_depth_shows_a_wrong_unit(depth: list[float], expected: float | None) -> None:
    assert implausible_median(torch.tensor(depth)) == pytest.approx(expected)
