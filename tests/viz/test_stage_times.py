"""Plots of the time per stage."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.trajectories import arc

from v3d_torch.viz.figure_output import embed_svg
from v3d_torch.viz.stage_times import draw_stage_bars, draw_stages_over_time


def test_times_of_stages_add_up() -> None:
    bars = draw_stage_bars({"read": 0.001, "objects": 0.05}).axes[0]
    assert [bar.get_width() for bar in bars.patches] == [1.0, 50.0]
    seconds = {"read": np.full(1000, 0.001), "objects": np.linspace(0, 0.1, 1000)}
    axes = draw_stages_over_time(np.arange(1000.0).tolist(), seconds).axes[0]
    highest = max(area.get_paths()[0].vertices[:, 1].max() for area in axes.collections)
    assert highest == pytest.approx(101, abs=0.5)  # milliseconds, all stages together


def test_times_are_interrupted_at_a_gap() -> None:
    stamps = [*range(300), *range(1000, 1300)]
    seconds = np.repeat([0.1, 0.2], 300)
    first, second = draw_stages_over_time(stamps, {"read": seconds}).axes[0].collections[0].get_paths()
    assert first.vertices.max(axis=0).tolist() == pytest.approx([300, 100])
    assert second.vertices.max(axis=0).tolist() == pytest.approx([1299.5, 200])
    assert second.vertices[:, 0].min() == 999


def test_time_of_a_single_frame_is_drawn() -> None:
    (area,) = draw_stages_over_time([5.0], {"read": np.array([0.1])}).axes[0].collections[0].get_paths()
    assert np.ptp(area.vertices, axis=0).tolist() == [1, 100]


@pytest.mark.parametrize("frames", [1, 2])
def test_one_or_two_frames_are_drawn(frames: int) -> None:
    stamps = arc().stamps[:frames].tolist()
    assert embed_svg(draw_stages_over_time(stamps, {"read": np.ones(frames)}), "stages").startswith("<svg")


def test_names_of_stages_are_not_formulas() -> None:
    """They come from the files of a run, which can be damaged."""
    name = r"$\frac{$"
    assert embed_svg(draw_stage_bars({name: 0.1}), "stages").startswith("<svg")
    assert embed_svg(draw_stages_over_time([0.0, 1.0], {name: np.ones(2)}), "stages").startswith("<svg")
