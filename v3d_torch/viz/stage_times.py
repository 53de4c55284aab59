"""Where the time goes: seconds of each stage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from v3d_torch.viz.timelines import WIDTH, rows

_MOST_STEPS = 240  # more than a page can show; between them the mean


def draw_stage_bars(per_frame: Mapping[str, float]) -> Figure:
    """A bar per stage with its mean time in a frame.

    Args:
        per_frame: seconds by stage, at least one.
    """
    figure = Figure(figsize=(WIDTH, 0.27 * len(per_frame) + 0.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    bars = axes.barh(list(per_frame), [1e3 * seconds for seconds in per_frame.values()], color=_colours(per_frame))
    axes.bar_label(bars, fmt="%.1f", padding=3, fontsize="small")
    axes.invert_yaxis()
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlabel("milliseconds a frame")
    axes.margins(x=0.08)
    return figure


def draw_stages_over_time(stamps: Sequence[float], seconds: Mapping[str, NDArray[np.float64]]) -> Figure:
    """The time of each frame, by stage.

    Args:
        stamps: of the frames, increasing.
        seconds: of each stage in each frame, shape :math:`(N,)`.
    """
    at = np.asarray(stamps) - stamps[0]
    parts = min(len(at), _MOST_STEPS)
    means = [[part.mean() for part in np.array_split(values, parts)] for values in seconds.values()]
    figure, (axes,) = rows(at.tolist(), [1.9], labels=0.5)
    centres = [part.mean() for part in np.array_split(at, parts)]
    axes.stackplot(
        centres, 1e3 * np.array(means), labels=list(seconds), colors=_colours(seconds), linewidth=0, step="mid"
    )
    axes.set(ylabel="milliseconds", ylim=(0, None))
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=8, frameon=False, fontsize=8)
    return figure


def _colours(stages: Mapping[str, object]) -> list[tuple[float, float, float, float]]:
    return [colormaps["tab20"](i % 20) for i in range(len(stages))]
