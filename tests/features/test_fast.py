"""FAST corners with an adaptive threshold."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from helpers.photographs import photograph
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from v3d_torch.features.fast import detect_corners
from v3d_torch.kernels.compiler import ENABLED, TWINS

TWIN = TWINS["v3d_torch.features.fast.detect_corners"]
THRESHOLD, MIN_THRESHOLD, CELL = 20, 7, 32
WHOLE = np.array([[3, 3, 93, 61]])
"""All pixels of an image of 96 x 64 with a whole circle around them."""

Image = NDArray[np.uint8]


def noise(seed: int, contrast: int, height: int = 64, width: int = 96) -> Image:
    return np.random.default_rng(seed).integers(100, 100 + contrast, (height, width), np.uint8)


def with_dots(dots: dict[tuple[int, int], int]) -> Image:
    """Grey image of 96 x 64 with pixels (column, row) that are this much brighter."""
    image = np.full((64, 96), 100, np.uint8)
    for (column, row), difference in dots.items():
        image[row, column] += difference
    return image


def detect(image: Image, boxes: NDArray[np.int64] = WHOLE) -> dict[tuple[int, int], int]:
    """Strength of each corner (column, row)."""
    corners, strength, _ = detect_corners(image, boxes, THRESHOLD, MIN_THRESHOLD, CELL)
    assert corners.shape == (len(strength), 2)
    return dict(zip(map(tuple, corners.tolist()), strength.tolist(), strict=True))


def test_strength_is_the_contrast_of_the_best_arc() -> None:
    """A dot is darker than the whole circle, but only nine adjacent pixels have to be this bright."""
    image = with_dots({})
    image[20, 30] = 50
    assert detect(image) == {(30, 20): 50}
    image[17:19, 26:34] = 40
    assert detect(image)[(30, 20)] == 50
    image[19:24, 27] = 40  # less than nine adjacent pixels remain
    assert (30, 20) not in detect(image)


def test_corners_of_one_threshold_are_those_of_opencv() -> None:
    """OpenCV removes both of two equal neighbours, and returns the largest threshold at which a pixel is a corner."""
    image = photograph("coffee")[1].numpy()
    height, width = image.shape
    corners, strength, _ = detect_corners(image, np.array([[3, 3, width - 3, height - 3]]), 20, 20, CELL)
    found = {(int(x), int(y)): s for (x, y), s in zip(corners.tolist(), strength.tolist(), strict=True)}
    others = cv2.FastFeatureDetector.create(20, nonmaxSuppression=True).detect(image)
    expected = {(int(point.pt[0]), int(point.pt[1])): int(point.response) + 1 for point in others}
    assert len(expected) > 500
    assert expected.items() <= found.items()
    assert len(found) < 1.1 * len(expected)


def test_weak_corners_are_detected_in_cells_without_strong_ones() -> None:
    image = with_dots({(10, 10): 10, (30, 30): 40, (40, 8): 9, (50, 20): 7, (70, 50): 20, (80, 40): 14})
    # The first cell has a strong corner, the second only weak ones, one of which is too weak.
    assert detect(image) == {(30, 30): 40, (40, 8): 9, (70, 50): 20, (80, 40): 14}


def test_a_strong_corner_outside_of_the_boxes_does_not_count() -> None:
    image = with_dots({(10, 10): 10, (30, 30): 40})
    assert detect(image, np.array([[3, 3, 30, 61]])) == {(10, 10): 10}
    assert detect(image, np.array([[3, 3, 31, 61]])) == {(30, 30): 40}


def test_the_first_of_equal_neighbours_is_the_corner() -> None:
    image = with_dots({(20, 20): 30, (21, 20): 30, (40, 30): 30, (39, 31): 30, (60, 20): 29, (61, 21): 30})
    assert detect(image) == {(20, 20): 30, (40, 30): 30, (61, 21): 30}


def test_maximum_between_pixels_is_that_of_the_parabola() -> None:
    """A dot has its contrast as strength; a neighbour that is as bright as the arc of the dot has the difference."""
    image = with_dots({(30, 20): 40, (31, 20): 30, (30, 19): 20, (60, 40): 25})
    corners, strength, offsets = detect_corners(image, WHOLE, THRESHOLD, MIN_THRESHOLD, CELL)
    assert corners.tolist() == [[30, 20], [60, 40]] and strength.tolist() == [40, 25]
    np.testing.assert_allclose(offsets, [[30 / (2 * (80 - 30)), -20 / (2 * (80 - 20))], [0, 0]])


@given(st.integers(0, 1000), st.integers(1, 150))
def test_maximum_between_pixels_is_within_half_a_pixel(seed: int, contrast: int) -> None:
    _, _, offsets = detect_corners(noise(seed, contrast), WHOLE, THRESHOLD, MIN_THRESHOLD, CELL)
    assert (np.abs(offsets) <= 0.5).all()


def test_pixels_outside_of_the_boxes_have_no_strength() -> None:
    image = with_dots({(30, 20): 40, (31, 20): 30})
    _, _, offsets = detect_corners(image, np.array([[3, 3, 31, 61]]), THRESHOLD, MIN_THRESHOLD, CELL)
    assert offsets.tolist() == [[0, 0]]


def test_corners_are_sorted_by_rows() -> None:
    corners, _, _ = detect_corners(noise(0, 60), WHOLE, THRESHOLD, MIN_THRESHOLD, CELL)
    assert len(corners) > 10
    assert (np.diff(corners @ [1, 96]) > 0).all()


@pytest.mark.parametrize("box", [[3, 3, 3, 61], [3, 3, 93, 3], [30, 3, 20, 61], [3, 40, 93, 20]])
def test_empty_boxes_have_no_corners(box: list[int]) -> None:
    assert detect(noise(0, 60), np.array([box])) == {}


@given(st.integers(0, 1000), st.integers(1, 80), st.sampled_from([8, 32, 200]), st.integers(4, 40), st.integers(4, 90))
@pytest.mark.skipif(not ENABLED, reason="numba is not installed, or V3D_KERNELS=torch is set")
def test_kernel_equals_its_twin(seed: int, contrast: int, cell: int, bottom: int, right: int) -> None:
    boxes = np.array([[3, 3, 93, bottom], [5, 256, right, 300]])  # no row of cells intersects both
    arguments = noise(seed, contrast, height=310), boxes, THRESHOLD, MIN_THRESHOLD, cell
    for result, expected in zip(TWIN.compiled(*arguments), TWIN.torch(*arguments), strict=True):
        np.testing.assert_array_equal(result, expected)
