"""Samples of depth images, and the choice of the views that are stored."""

from __future__ import annotations

import pytest
import torch
from helpers.box_room import CAMERA
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.geometry.depth_units import STORED_UNIT
from v3d_torch.geometry.se3 import invert, se3_exp, se3_log
from v3d_torch.occupancy.range_view import RangeView
from v3d_torch.occupancy.view_store import LEVER, ViewStore, displacement

EYE = torch.eye(4, dtype=torch.float64)
ALL = torch.ones(CAMERA.height, CAMERA.width, dtype=torch.bool)


def poses_of(*x: float) -> list[Tensor]:
    """World-to-camera poses along a line."""
    return [se3_exp(torch.tensor([-each, 0, 0, 0, 0, 0], dtype=torch.float64)) for each in x]


def store_of(capacity: int, *x: float) -> ViewStore:
    """Store to which views at these places were added."""
    store, view = ViewStore(capacity), RangeView.sample(0, torch.ones(240, 320), ALL, 8)
    for frame, T_cw in enumerate(poses_of(*x)):
        store.append(view, frame, T_cw, EYE)
        store.reduce()
    return store


def test_samples_have_the_depth_and_ray_of_their_pixels() -> None:
    depth = torch.rand(240, 320, generator=torch.Generator().manual_seed(0)) * 4
    depth[::7] = 0.0
    depth[5:8, 5:8] = 20.0  # beyond the range of the stored units
    depth[::11] = torch.inf
    depth[::13] = torch.nan
    for number in range(5):
        view = RangeView.sample(number, depth, ALL, 8)
        assert view.depth.shape == view.static.shape == (30, 40) and view.static.all()
        picked = depth[view.row :: 8, view.column :: 8]
        expected = torch.where(picked.isfinite(), picked.clamp(max=(2**16 - 1) * STORED_UNIT), 0)
        torch.testing.assert_close(view.depth, expected, rtol=0, atol=STORED_UNIT / 2 + 1e-6)
        assert torch.equal(view.rays(CAMERA, 8), CAMERA.rays[view.row :: 8, view.column :: 8])


def test_all_pixels_are_sampled_over_time() -> None:
    offsets = [
        (view.row, view.column) for view in (RangeView.sample(i, torch.ones(240, 320), ALL, 8) for i in range(200))
    ]
    assert set(offsets) == {(row, column) for row in range(8) for column in range(8)}
    assert len(set(offsets[:16])) == 16


@pytest.mark.parametrize("stride", [1, 3, 8, 100])
def test_images_whose_size_is_no_multiple_of_the_stride_have_samples_of_one_shape(stride: int) -> None:
    shapes = {RangeView.sample(number, torch.ones(240, 320), ALL, stride).depth.shape for number in range(30)}
    assert shapes == {(240 // stride, 320 // stride)}


def test_samples_next_to_moving_pixels_are_not_static() -> None:
    static = ALL.clone()
    static[100:140, 100:140] = False
    view = RangeView.sample(3, torch.ones(240, 320), static, 8)
    moving = ~static[view.row :: 8, view.column :: 8]
    rows, columns = torch.nonzero(moving).unbind(dim=1)
    expected = torch.ones_like(moving)
    expected[int(rows.min()) - 1 : int(rows.max()) + 2, int(columns.min()) - 1 : int(columns.max()) + 2] = False
    assert torch.equal(view.static, expected)


@settings(max_examples=30)
@given(
    first=st.lists(st.floats(-2, 2), min_size=6, max_size=6), second=st.lists(st.floats(-2, 2), min_size=6, max_size=6)
)
def test_displacement_is_translation_plus_rotation_times_the_lever(first: list[float], second: list[float]) -> None:
    a, b = (se3_exp(torch.tensor(xi, dtype=torch.float64)) for xi in (first, second))
    relative = a @ invert(b)
    expected = relative[:3, 3].norm() + LEVER * se3_log(relative)[3:].norm()
    torch.testing.assert_close(displacement(a[None], b)[0], expected, rtol=1e-6, atol=1e-6)


def test_views_are_kept_up_to_the_capacity() -> None:
    assert store_of(5, 0, 1, 2, 3, 4).frames == [0, 1, 2, 3, 4]


def test_newest_of_the_views_at_one_place_is_kept() -> None:
    assert store_of(5, 0.01, 1.01, 2.51, 1.02, 1.03, 4.01).frames == [0, 2, 4, 5]


def test_camera_at_rest_keeps_the_newest_view_and_all_other_places() -> None:
    store = store_of(5, 0.01, 1.01, 2.01, *50 * [3.01])
    assert {0, 1, 2, 52} <= set(store.frames) and len(store) <= 5


def test_turned_cameras_at_one_place_are_kept() -> None:
    store, view = ViewStore(10), RangeView.sample(0, torch.ones(240, 320), ALL, 8)
    for frame in range(60):
        twist = torch.zeros(6, dtype=torch.float64)
        twist[4] = 2 * torch.pi * (frame % 6) / 6
        store.append(view, frame, se3_exp(twist), EYE)
        store.reduce()
    assert {frame % 6 for frame in store.frames} == set(range(6)) and min(store.frames[:6]) > 40


def test_path_is_thinned_evenly() -> None:
    store = store_of(60, *(0.05 * i for i in range(200)))
    gaps = torch.tensor(store.frames).diff()
    assert len(store) <= 60 and store.frames[0] < 10 and store.frames[-1] == 199 and gaps.max() <= 9


def test_farthest_views_are_removed_on_a_long_path(caplog: pytest.LogCaptureFixture) -> None:
    store = store_of(20, *(0.5 * i for i in range(200)))
    assert len(store) <= 20 and store.frames == list(range(200 - len(store), 200))
    assert "farthest from the camera" in caplog.text


@settings(max_examples=20)
@given(x=st.lists(st.floats(0, 10), min_size=8, max_size=40))
def test_newest_view_is_kept_and_the_order_does_not_change(x: list[float]) -> None:
    store, view = ViewStore(6), RangeView.sample(0, torch.ones(240, 320), ALL, 8)
    for frame, T_cw in enumerate(poses_of(*x)):
        store.append(view, frame, T_cw, EYE)
        before = list(store.frames)
        kept = store.reduce()
        assert len(store) <= 6 and store.frames[-1] == frame and store.frames == sorted(store.frames)
        assert (kept is None) == (len(before) <= 6)
        assert kept is None or [each for each, keep in zip(before, kept.tolist(), strict=True) if keep] == store.frames
        assert torch.equal(store.T_dw, torch.stack([poses_of(x[each])[0] for each in store.frames]))
