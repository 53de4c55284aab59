"""Edges of surfaces: planes at any tilt have none, contacts of two surfaces have one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from v3d_torch.objects.surface_edges import find_concave_edges, find_smooth_pixels

ROWS, COLUMNS = 60, 80
STEP = 4
FOCAL_LENGTH = 525.0
FLOOR = 1.4
"""Distance of the floor below the camera, metres."""


def depth_from(inverse: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the depth of cells from their inverse depth, 0 where it is not positive."""
    return np.where(inverse > 0, 1 / np.maximum(inverse, 1e-6), 0).astype(np.float32)


def floor() -> NDArray[np.float64]:
    """Return the inverse depth of the floor, whose horizon is the first row."""
    row = STEP * np.arange(ROWS) / (FOCAL_LENGTH * FLOOR)
    return np.tile(row[:, None], (1, COLUMNS))


slopes = st.floats(-0.01, 0.01)


@given(offset=st.floats(0.2, 2.0), along_rows=slopes, along_columns=slopes)
def test_plane_has_no_concave_edge(offset: float, along_rows: float, along_columns: float) -> None:
    v, u = np.mgrid[:ROWS, :COLUMNS]
    assert not find_concave_edges(depth_from(offset + along_rows * v + along_columns * u)).any()


def test_foot_on_the_floor_at_any_distance_is_a_concave_edge() -> None:
    for contact in (15, 30, 45):
        foot = floor()[contact, 0]  # an upright surface that ends on the floor
        edges = find_concave_edges(depth_from(np.maximum(floor(), foot)))
        assert set(np.flatnonzero(edges.any(axis=1))) <= set(range(contact - 2, contact + 3))
        assert edges[contact].all()


def test_edge_along_columns_is_found_as_along_rows() -> None:
    inverse = np.maximum(floor(), floor()[30, 0])
    np.testing.assert_array_equal(find_concave_edges(depth_from(inverse.T)), find_concave_edges(depth_from(inverse)).T)


def test_convex_edge_is_none() -> None:
    """The corner of a box that points at the camera."""
    distance = np.abs(np.arange(COLUMNS) - COLUMNS // 2)
    assert not find_concave_edges(depth_from(np.tile(1.0 - 0.008 * distance, (ROWS, 1)))).any()


def test_cells_without_depth_give_no_edge() -> None:
    inverse = np.maximum(floor(), floor()[30, 0])
    inverse[27] = 0
    assert not find_concave_edges(depth_from(inverse))[30].any()


def test_images_smaller_than_the_reach_have_no_edge() -> None:
    for size in range(1, 7):
        assert not find_concave_edges(np.ones((size, size), np.float32)).any()


def test_depth_step_is_not_smooth() -> None:
    depth = np.full((ROWS, COLUMNS), 2.0, np.float32)
    depth[:, 40:] = 2.2
    smooth = find_smooth_pixels(depth, STEP, 0.04)
    assert not smooth[:, 10].any()
    assert np.delete(smooth, 10, axis=1).all()
    assert find_smooth_pixels(depth, STEP, 0.2).all()


@pytest.mark.parametrize("roll", [0, 30, 45, 60, 90, 135])
def test_foot_on_the_floor_is_found_at_any_roll_of_the_camera(roll: float) -> None:
    """Rows and columns cross a diagonal edge at a shorter distance, over which the bend is too small."""
    v, u = np.mgrid[:ROWS, :COLUMNS] - np.array([ROWS // 2, COLUMNS // 2])[:, None, None]
    below = np.cos(np.radians(roll)) * v + np.sin(np.radians(roll)) * u
    per_cell = STEP / (FOCAL_LENGTH * FLOOR)
    edges = find_concave_edges(depth_from(0.5 + per_cell * np.maximum(below, 0)))
    inner = edges[4:-4, 4:-4], np.abs(below)[4:-4, 4:-4]
    assert inner[0][inner[1] < 0.5].all() and not inner[0][inner[1] > 3].any()
