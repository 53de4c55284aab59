"""Axes over time, shared by all plots of a run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

WIDTH = 9.0
"""Width of all plots of a report, inches."""


def make_time_axes(
    seconds: Sequence[float], heights: Sequence[float], *, extra_height: float = 0.0
) -> tuple[Figure, list[Axes]]:
    """Create a figure with axes one below the other that share the time axis.

    Args:
        seconds: Time of each frame since the first, seconds, increasing.
        heights: Height of each of the axes, inches.
        extra_height: Height of a legend, inches.
    """
    figure = Figure(figsize=(WIDTH, sum(heights) + 0.25 * len(heights) + 0.4 + extra_height), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(True, linewidth=0.4, alpha=0.4)
    margin = 0.01 * seconds[-1] + 1e-3
    panels[-1].set(xlabel="time since the first frame [s]", xlim=(-margin, seconds[-1] + margin))
    return figure, list(panels)


def cell_edges(seconds: Sequence[float]) -> NDArray[np.float64]:
    """Return the edges of one cell per frame: times halfway between frames, shape (frames + 1,)."""
    if len(seconds) == 1:
        return np.array([seconds[0] - 0.5, seconds[0] + 0.5])
    times = np.asarray(seconds)
    middles = (times[1:] + times[:-1]) / 2
    return np.concatenate([[2 * times[0] - middles[0]], middles, [2 * times[-1] - middles[-1]]])
