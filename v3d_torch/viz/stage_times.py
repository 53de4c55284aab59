"""Plots of the time spent in each stage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from v3d_torch.viz.time_axes import WIDTH, frame_cells, make_time_axes

_MAX_STEPS = 240
"""Maximum number of steps of a plot over time, about one per two pixels of a page. Longer runs are averaged."""


def draw_stage_bars(seconds_per_frame: Mapping[str, float]) -> Figure:
    """Draw one bar per stage with its mean time per frame.

    Args:
        seconds_per_frame: Mean time of each stage, seconds, at least one stage.
    """
    figure = Figure(figsize=(WIDTH, 0.27 * len(seconds_per_frame) + 0.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    milliseconds = [1e3 * seconds for seconds in seconds_per_frame.values()]
    bars = axes.barh(range(len(milliseconds)), milliseconds, color=_colours(seconds_per_frame))
    axes.set_yticks(range(len(milliseconds)), list(seconds_per_frame), parse_math=False)  # names come from a file
    axes.bar_label(bars, fmt="%.1f", padding=3, fontsize="small")
    axes.invert_yaxis()
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlabel("mean time per frame [ms]")
    axes.margins(x=0.08)
    return figure


def draw_stages_over_time(stamps: Sequence[float], seconds: Mapping[str, NDArray[np.float64]]) -> Figure:
    """Draw the time of each frame, stacked by stage; empty at gaps.

    Args:
        stamps: Timestamps of the frames, seconds, increasing.
        seconds: Time of each stage in each frame, seconds, shape :math:`(N,)`.
    """
    times = (np.asarray(stamps) - stamps[0]).tolist()
    edges, cells = frame_cells(times, np.array(list(seconds.values())))
    count, gaps = cells.shape[1], np.flatnonzero(np.isnan(cells[0]))
    regular = np.linspace(0, count, min(count, _MAX_STEPS), endpoint=False, dtype=np.int64)
    starts = np.unique(np.concatenate([regular, gaps, gaps + 1]))  # no step is an average over a gap
    means = np.add.reduceat(cells, starts, axis=1) / np.diff(starts, append=count)
    x = np.repeat(edges[[*starts, count]], 2)[1:-1]  # both ends of each step
    figure, (axes,) = make_time_axes(times, [1.9], extra_height=0.5)
    axes.stackplot(x, 1e3 * np.repeat(means, 2, axis=1), labels=list(seconds), colors=_colours(seconds), linewidth=0)
    axes.set(ylabel="time per frame [ms]", ylim=(0, None))
    handles = axes.get_legend_handles_labels()
    legend = figure.legend(*handles, loc="outside upper center", ncols=8, frameon=False, fontsize=8)
    for text in legend.get_texts():
        text.set_parse_math(False)
    return figure


def _colours(stages: Mapping[str, object]) -> list[tuple[float, float, float, float]]:
    return [colormaps["tab20"](i % 20) for i in range(len(stages))]
