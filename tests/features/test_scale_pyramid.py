"""Scale pyramid in one image."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from v3d_torch.config import FeaturesConfig
from v3d_torch.features.scale_pyramid import ScalePyramid, octaves_of_levels


def test_levels_are_below_each_other() -> None:
    pyramid = ScalePyramid(100, 80, range(3), 1.25, 10)
    assert pyramid.sizes == [(100, 80), (80, 64), (64, 51)]
    assert pyramid.tops.tolist() == [0, 80, 144]
    grey = np.random.default_rng(0).integers(0, 256, (80, 100), np.uint8)
    canvas = pyramid.build(grey)
    assert canvas.shape == (195, 100)
    np.testing.assert_array_equal(canvas[:80], grey)
    second = np.asarray(cv2.resize(grey, (80, 64), interpolation=cv2.INTER_LINEAR))
    np.testing.assert_array_equal(canvas[80:144, :80], second)
    np.testing.assert_array_equal(canvas[144:, :64], cv2.resize(second, (64, 51), interpolation=cv2.INTER_LINEAR))


def test_last_column_of_a_level_is_repeated_beside_it() -> None:
    canvas = ScalePyramid(100, 80, range(2), 1.25, 10).build(
        np.random.default_rng(0).integers(0, 256, (80, 100), np.uint8)
    )
    np.testing.assert_array_equal(canvas[80:, 80:], canvas[80:, 79:80].repeat(20, axis=1))


def test_boxes_are_the_levels_without_their_margin() -> None:
    pyramid = ScalePyramid(100, 80, range(3), 1.25, 10)
    assert pyramid.boxes.tolist() == [[10, 10, 90, 70], [10, 90, 70, 134], [10, 154, 54, 185]]
    assert pyramid.level_of_row[[10, 69, 90, 133, 154]].tolist() == [0, 0, 1, 1, 2]


@pytest.mark.parametrize(
    ("columns", "finest"), [(80, 80), (640, 640), (1000, 1000), (1280, 889), (1440, 1000), (1920, 926), (4096, 953)]
)
def test_finest_level_of_a_large_image_is_smaller_than_the_image(columns: int, finest: int) -> None:
    config = FeaturesConfig()
    octaves = octaves_of_levels(config, columns)
    pyramid = ScalePyramid(columns, 3 * columns // 4, octaves, config.scale, 10)
    assert pyramid.sizes[0][0] == finest
    assert len(octaves) == config.levels and (octaves[0] == 0) == (finest == columns)


def test_large_image_is_averaged_not_sampled() -> None:
    """Half of the pixels of a checkerboard are white; a finest level of sampled pixels would have a pattern."""
    pyramid = ScalePyramid(200, 160, range(4, 5), 1.25, 10)
    board = np.indices((160, 200)).sum(axis=0, dtype=np.int64) % 2 * 255
    level = pyramid.build(board.astype(np.uint8))
    assert level.shape == (66, 82)
    assert np.abs(level.astype(int) - 127.5).max() < 40


@pytest.mark.parametrize(
    ("size", "levels"), [((20, 20), 1), ((48, 60), 1), ((60, 48), 1), ((50, 60), 2), ((640, 480), 8)]
)
def test_levels_without_pixels_inside_are_left_out(size: tuple[int, int], levels: int) -> None:
    assert len(ScalePyramid(*size, range(8), 1.2, 20).sizes) == levels
