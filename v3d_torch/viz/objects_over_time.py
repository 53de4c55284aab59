"""Verdicts, votes and Chamfer distances of each object over time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from v3d_torch.viz.figures import MOTION_STATE_COLOURS, parse_motion_state
from v3d_torch.viz.timelines import borders, rows

_MOST_OBJECTS = 20  # rows that a page holds
_ROW = 0.17  # inches


@dataclass(frozen=True)
class ObjectRow:
    """What is said of one object in one frame.

    Attributes:
        stamp: seconds.
        id: of the object.
        name: of its class.
        verdict: one of `MOTION_STATE_COLOURS`.
        votes: that it has.
        chamfer: metres; nan where it was not measured.
    """

    stamp: float
    id: int
    name: str
    motion_state: str
    votes: int
    chamfer: float


def draw_objects_over_time(
    stamps: Sequence[float], table: Sequence[ObjectRow], chamfer_threshold: float | None
) -> tuple[Figure, int]:
    """A row per object: its verdicts as colours, and below, for those that have any, votes and Chamfer distances.

    Objects that were ever anything but static come first in the choice, then those seen for longest.

    Args:
        stamps: of all frames, increasing.
        table: at least one row; stamps among those of the frames.
        chamfer_threshold: distance above which an object deforms, metres; None when it is not known.

    Returns:
        The figure, and how many objects it has no room for.
    """
    ids, left_out = _chosen(table)
    names = {row.id: f"{row.name} {row.id}" for row in table}
    verdicts = list(MOTION_STATE_COLOURS)
    grids = {
        "motion_state": _grid(stamps, ids, table, lambda row: verdicts.index(parse_motion_state(row.motion_state))),
        "votes": _grid(stamps, ids, table, lambda row: row.votes),
        "chamfer": _grid(stamps, ids, table, lambda row: row.chamfer),
    }
    voted = [i for i, row in enumerate(grids["votes"]) if np.nanmax(row, initial=0) > 0]
    measured = [i for i, row in enumerate(grids["chamfer"]) if np.isfinite(row).any()]
    panels = [("motion_state", list(range(len(ids)))), ("votes", voted), ("chamfer", measured)]
    panels = [(what, chosen) for what, chosen in panels if chosen]
    seconds = [stamp - stamps[0] for stamp in stamps]
    figure, axes = rows(seconds, [max(3, len(chosen)) * _ROW for _, chosen in panels], labels=0.3)
    for one, (what, chosen) in zip(axes, panels, strict=True):
        _paint(one, borders(seconds), grids[what][chosen], what, chamfer_threshold)
        one.set_yticks(np.arange(len(chosen)) + 0.5, [names[ids[i]] for i in chosen], fontsize="x-small")
        one.grid(False)
    said = {parse_motion_state(row.motion_state) for row in table}
    handles = [
        Patch(color=colour, label=verdict) for verdict, colour in MOTION_STATE_COLOURS.items() if verdict in said
    ]
    figure.legend(handles=handles, loc="outside upper right", ncols=len(handles), frameon=False)
    return figure, left_out


def _chosen(table: Sequence[ObjectRow]) -> tuple[list[int], int]:
    """The objects worth a row, in the order in which they were first seen, and how many others there are."""
    frames: dict[int, int] = {}
    lively: set[int] = set()
    for row in table:
        frames[row.id] = frames.get(row.id, 0) + 1
        if parse_motion_state(row.motion_state) in ("dynamic", "deforming"):
            lively.add(row.id)
    best = sorted(frames, key=lambda number: (number not in lively, -frames[number], number))[:_MOST_OBJECTS]
    return [number for number in frames if number in set(best)], len(frames) - len(best)


def _grid(
    stamps: Sequence[float], ids: Sequence[int], table: Sequence[ObjectRow], value: Callable[[ObjectRow], float]
) -> NDArray[np.float64]:
    """A value for each object and frame, nan where there is none, shape (objects, frames)."""
    row_of, column_of = {number: i for i, number in enumerate(ids)}, {stamp: i for i, stamp in enumerate(stamps)}
    grid = np.full((len(ids), len(stamps)), np.nan)
    for row in table:
        if row.id in row_of:
            grid[row_of[row.id], column_of[row.stamp]] = value(row)
    return grid


def _paint(
    axes: Axes, edges: NDArray[np.float64], grid: NDArray[np.float64], what: str, chamfer_threshold: float | None
) -> None:
    rest = np.arange(len(grid) + 1)
    if what == "motion_state":
        title = "verdicts"
        colours = ListedColormap(list(MOTION_STATE_COLOURS.values()))
        axes.pcolormesh(
            edges, rest, grid, cmap=colours, vmin=-0.5, vmax=len(MOTION_STATE_COLOURS) - 0.5, rasterized=True
        )
    else:
        above = f", deforming above {chamfer_threshold:g}" if chamfer_threshold is not None else ""
        title = "votes" if what == "votes" else f"Chamfer distance to its own past [m]{above}"
        nothing = 0.5 if what == "votes" else 0.0  # no vote at all is pale
        scale = colormaps["viridis"].with_extremes(under=(0.5, 0.5, 0.5, 0.2))
        most = float(np.nanquantile(grid, 1.0 if what == "votes" else 0.98))  # one wild distance must not darken all
        mesh = axes.pcolormesh(edges, rest, grid, cmap=scale, vmin=nothing, vmax=most, rasterized=True)
        axes.figure.colorbar(mesh, ax=axes, pad=0.01, aspect=12, ticks=MaxNLocator(4, integer=what == "votes"))
    axes.set_title(title, loc="left", fontsize="small")
    axes.set_ylim(len(grid), 0)
