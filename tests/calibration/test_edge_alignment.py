"""Shift and delay of depth images, found from occlusion boundaries."""

from __future__ import annotations

import pytest
import torch
from helpers.board_room import make_views

from v3d_torch.calibration.edge_alignment import EdgeAlignment, Misalignment

ZERO = torch.zeros(3, dtype=torch.float64)


def align(**settings: object) -> tuple[EdgeAlignment, Misalignment]:
    views, trajectory = make_views(**settings)  # type: ignore[arg-type]
    alignment = EdgeAlignment(views, trajectory, depth_delay=0.0)
    return alignment, alignment.refine(alignment.search())


@pytest.mark.parametrize(
    ("shift", "delay"), [((0, 0), 0.0), ((12, -8), 0.0), ((-24, 16), 0.05), ((0, 0), -0.04), ((0, 0), 0.08)]
)
def test_shift_and_delay_are_found(shift: tuple[int, int], delay: float) -> None:
    _, found = align(shift=shift, delay=delay)
    expected = torch.tensor([-shift[0], -shift[1], delay], dtype=torch.float64)
    assert bool(((found.values - expected).abs() < torch.tensor([1.5, 1.5, 0.004])).all()), found.values


def test_shift_of_frames_with_more_columns_can_be_larger() -> None:
    views, trajectory = make_views(shift=(60, 0), zoom=4)  # 1280 columns
    found = EdgeAlignment(views, trajectory, depth_delay=0.0).search((0, 1))
    assert found.tolist() == pytest.approx([-60, 0, 0], abs=4)


def test_stated_delay_is_not_found_again() -> None:
    _, found = align(delay=0.05, stated_delay=0.05)
    assert float(found.values[2]) == pytest.approx(0.0, abs=0.003)


def test_camera_states_the_delay_that_timestamps_do_not() -> None:
    views, trajectory = make_views(delay=0.05)
    alignment = EdgeAlignment(views, trajectory, depth_delay=0.05)
    assert float(alignment.refine(ZERO).values[2]) == pytest.approx(0.0, abs=0.003)


def test_better_values_are_distinguished_from_equal_ones() -> None:
    shifted, found = align(shift=(20, 0))
    assert shifted.is_better(found.values, ZERO)
    assert not shifted.is_better(ZERO, found.values)
    registered, found = align()
    assert not registered.is_better(found.values, ZERO)


def test_values_must_be_better_in_both_halves_of_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """Edges of objects that only some consecutive views show fit by chance."""
    views, trajectory = make_views(12)
    alignment = EdgeAlignment(views, trajectory, depth_delay=0.0)
    for first_half, expected in ((1.05, True), (0.95, False)):
        score_of_view = torch.tensor(6 * [first_half] + 6 * [3.0])[alignment._view]
        monkeypatch.setattr(
            alignment, "_scores", lambda values, better=score_of_view: better if values[0] else torch.ones(len(better))
        )
        assert alignment.is_better(torch.tensor([17.0, 0.0, 0.0]), ZERO) == expected


def test_camera_at_rest_determines_the_shift_and_no_delay() -> None:
    _, found = align(shift=(12, -8), moving=False)
    torch.testing.assert_close(found.values[:2], torch.tensor([-12.0, 8.0]).double(), rtol=0, atol=1.5)
    assert not float(found.sigma[2]) < 0.05


def test_views_without_boundaries_do_not_count() -> None:
    views, trajectory = make_views(2, scale=0.0)
    assert len(EdgeAlignment(views, trajectory, depth_delay=0.0)) == 0


def test_number_of_views_is_limited_and_spread_over_the_run() -> None:
    views, trajectory = make_views(6)
    assert len(EdgeAlignment(views, trajectory, 0.0)) == 6
    assert len(EdgeAlignment(views, trajectory, 0.0, max_views=3)) == 3


def test_search_leaves_values_that_are_not_free_at_zero() -> None:
    views, trajectory = make_views(shift=(12, -8))
    alignment = EdgeAlignment(views, trajectory, depth_delay=0.0)
    assert alignment.search((0, 1)).tolist() == pytest.approx([-12, 8, 0], abs=2)
    assert alignment.search((2,))[:2].tolist() == [0, 0]
