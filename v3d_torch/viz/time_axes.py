"""Axes over time, shared by all plots of a run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from v3d_torch.viz.time_gaps import find_gaps

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


def frame_cells(seconds: Sequence[float], grid: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Arrange the values of frames as cells for `Axes.pcolormesh`. Gaps are empty.

    A cell ends halfway to the next frame, or one median interval after its frame if a gap follows.

    Args:
        seconds: Time of each frame, increasing.
        grid: Values, one column per frame, shape (rows, frames).

    Returns:
        Edges of the columns, shape (columns + 1,), and values with NaN columns at gaps, shape (rows, columns).
    """
    times = np.asarray(seconds, np.float64)
    step = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    middles = (times[1:] + times[:-1]) / 2
    edges = np.concatenate([[times[0] - step / 2], middles, [times[-1] + step / 2]])
    after_gap = find_gaps(times)
    edges[after_gap] = times[after_gap] - step
    edges = np.insert(edges, after_gap, times[after_gap - 1] + step)
    return edges, np.insert(grid, after_gap, np.nan, axis=1)
