"""Plots of objects over time: rows, values, selection."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.trajectories import arc

from v3d_torch.viz.figure_output import embed_svg
from v3d_torch.viz.object_overlay import MOTION_STATE_COLOURS
from v3d_torch.viz.object_timelines import ObjectRow, draw_object_timelines


def test_each_object_has_a_row_and_moving_objects_are_preferred() -> None:
    def rows(
        id_: int, motion_state: str, frames: range, votes: int = 0, chamfer: float = float("nan")
    ) -> list[ObjectRow]:
        return [ObjectRow(10.0 + t, id_, "person", motion_state, votes, chamfer) for t in frames]

    stamps = [10.0 + t for t in range(10)]
    table = [
        *rows(1, "static", range(10)),
        *rows(2, "dynamic", range(4, 6), votes=3),
        *rows(3, "deforming", range(2, 9), chamfer=0.04),
    ]
    figure, omitted = draw_object_timelines(stamps, table, 0.025)
    assert omitted == 0
    states, votes, chamfer = figure.axes[:3]  # followed by the colour scales
    names = [[tick.get_text() for tick in axes.get_yticklabels()] for axes in (states, votes, chamfer)]
    assert names == [["person 1", "person 2", "person 3"], ["person 2"], ["person 3"]]
    grid = np.ma.filled(states.collections[0].get_array().reshape(3, 10), np.nan)
    order = list(MOTION_STATE_COLOURS)
    assert grid[0].tolist() == [order.index("static")] * 10
    assert np.flatnonzero(grid[1] == order.index("dynamic")).tolist() == [4, 5] and np.isnan(grid[1]).sum() == 8
    assert np.flatnonzero(grid[2] == order.index("deforming")).tolist() == list(range(2, 9))
    assert np.nanmax(np.ma.filled(chamfer.collections[0].get_array(), np.nan)) == 0.04
    crowd = [row for id_ in range(4, 40) for row in rows(id_, "static", range(id_ % 7 + 1))]
    figure, omitted = draw_object_timelines(stamps, [*table, *crowd], None)
    names = [tick.get_text() for tick in figure.axes[0].get_yticklabels()]
    assert omitted == 19 and len(names) == 20 and {"person 1", "person 2", "person 3"} <= set(names)


def test_class_name_is_drawn_as_it_is() -> None:
    """The report reads names from a file, which need not be from this package."""
    table = [ObjectRow(0.0, 1, r"$\frac{$ x", "static", 0, float("nan"))]
    assert r"$\frac{$ x 1" in embed_svg(draw_object_timelines([0.0, 1.0], table, None)[0], "objects")


@pytest.mark.parametrize("frames", [1, 2])
def test_one_or_two_frames_are_drawn(frames: int) -> None:
    stamps = arc().stamps[:frames].tolist()
    table = [ObjectRow(stamps[0], 1, "cup", "static", 0, float("nan"))]
    assert embed_svg(draw_object_timelines(stamps, table, None)[0], "objects").startswith("<svg")


@pytest.mark.parametrize("most", [1, 2, 3, 9])
def test_colour_scale_of_votes_has_whole_numbers(most: int) -> None:
    stamps = [0.1 * t for t in range(10)]
    table = [ObjectRow(stamp, 1, "person", "dynamic", 1 + t % most, float("nan")) for t, stamp in enumerate(stamps)]
    figure, _ = draw_object_timelines(stamps, table, None)
    figure.canvas.draw()
    scale = figure.axes[-1]
    labels = [tick.get_text() for tick in scale.get_yticklabels()]
    low, high = scale.get_ylim()
    shown = [label for tick, label in zip(scale.get_yticks(), labels, strict=True) if low <= tick <= high]
    assert shown and all(label.isdecimal() for label in shown), shown
