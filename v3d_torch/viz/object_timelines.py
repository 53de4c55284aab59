"""Plots over time of the objects: motion state, votes and Chamfer distance."""

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

from v3d_torch.viz.object_overlay import MOTION_STATE_COLOURS, parse_motion_state
from v3d_torch.viz.time_axes import frame_cells, make_time_axes

_MAX_OBJECTS = 20  # rows that fit on a page
_ROW_HEIGHT = 0.17  # inches
_MIN_ROWS = 3  # height of a panel in rows, so that its title and colour scale fit
_CHAMFER_QUANTILE = 0.98  # upper end of the colour scale, so that one outlier does not darken everything


@dataclass(frozen=True)
class ObjectRow:
    """One object in one frame.

    Attributes:
        stamp: Timestamp of the frame, seconds.
        id: Id of the object.
        name: Name of the object's class.
        motion_state: One of `MOTION_STATE_COLOURS`.
        votes: Number of votes for the object.
        chamfer: Root-mean-square nearest-neighbour distance to the earlier cloud, metres; NaN if it was not measured.
    """

    stamp: float
    id: int
    name: str
    motion_state: str
    votes: int
    chamfer: float


def draw_object_timelines(
    stamps: Sequence[float], table: Sequence[ObjectRow], chamfer_threshold: float | None
) -> tuple[Figure, int]:
    """Draw the motion state of each object in a row; below, votes and Chamfer distances of the objects with any.

    If there are more objects than rows, objects that were dynamic or deforming are preferred, then the objects with the
    most frames.

    Args:
        stamps: Timestamps of all frames, seconds, increasing.
        table: Objects of all frames, at least one row, with timestamps among those of the frames.
        chamfer_threshold: Distance above which an object is deforming, metres; None if not known.

    Returns:
        The figure, and the number of objects without a row.
    """
    ids, omitted = _select_objects(table)
    labels = {row.id: f"{row.name} {row.id}" for row in table}
    states = list(MOTION_STATE_COLOURS)
    motion_state = _grid(stamps, ids, table, lambda row: states.index(parse_motion_state(row.motion_state)))
    votes = _grid(stamps, ids, table, lambda row: row.votes)
    chamfer = _grid(stamps, ids, table, lambda row: row.chamfer)
    voted = [i for i, row in enumerate(votes) if np.nanmax(row, initial=0) > 0]
    measured = [i for i, row in enumerate(chamfer) if np.isfinite(row).any()]
    panels: list[tuple[list[int], Callable[[Axes, Sequence[float]], None]]] = [
        (list(range(len(ids))), lambda axes, times: _draw_motion_states(axes, times, motion_state)),
        (voted, lambda axes, times: _draw_votes(axes, times, votes[voted])),
        (measured, lambda axes, times: _draw_chamfer(axes, times, chamfer[measured], chamfer_threshold)),
    ]
    panels = [(rows, draw) for rows, draw in panels if rows]
    seconds = [stamp - stamps[0] for stamp in stamps]
    heights = [max(_MIN_ROWS, len(rows)) * _ROW_HEIGHT for rows, _ in panels]
    figure, all_axes = make_time_axes(seconds, heights, extra_height=0.3)
    for axes, (rows, draw) in zip(all_axes, panels, strict=True):
        draw(axes, seconds)
        axes.set_ylim(len(rows), 0)
        names = [labels[ids[i]] for i in rows]
        axes.set_yticks(np.arange(len(rows)) + 0.5, names, fontsize="x-small", parse_math=False)
        axes.grid(False)
    present = {parse_motion_state(row.motion_state) for row in table}
    handles = [Patch(color=colour, label=name) for name, colour in MOTION_STATE_COLOURS.items() if name in present]
    figure.legend(handles=handles, loc="outside upper right", ncols=len(handles), frameon=False)
    return figure, omitted


def _select_objects(table: Sequence[ObjectRow]) -> tuple[list[int], int]:
    """Return the ids of the objects with a row, in order of appearance, and the number of other objects."""
    frames: dict[int, int] = {}
    moving: set[int] = set()
    for row in table:
        frames[row.id] = frames.get(row.id, 0) + 1
        if parse_motion_state(row.motion_state) in ("dynamic", "deforming"):
            moving.add(row.id)
    selected = sorted(frames, key=lambda id_: (id_ not in moving, -frames[id_], id_))[:_MAX_OBJECTS]
    return [id_ for id_ in frames if id_ in set(selected)], len(frames) - len(selected)


def _grid(
    stamps: Sequence[float], ids: Sequence[int], table: Sequence[ObjectRow], value: Callable[[ObjectRow], float]
) -> NDArray[np.float64]:
    """Return a value for each object and frame, NaN if the object is absent, shape (objects, frames)."""
    row_of, column_of = {id_: i for i, id_ in enumerate(ids)}, {stamp: i for i, stamp in enumerate(stamps)}
    grid = np.full((len(ids), len(stamps)), np.nan)
    for row in table:
        if row.id in row_of:
            grid[row_of[row.id], column_of[row.stamp]] = value(row)
    return grid


def _draw_motion_states(axes: Axes, seconds: Sequence[float], grid: NDArray[np.float64]) -> None:
    colours = ListedColormap(list(MOTION_STATE_COLOURS.values()))
    vmax = len(MOTION_STATE_COLOURS) - 0.5
    edges, cells = frame_cells(seconds, grid)
    axes.pcolormesh(edges, np.arange(len(grid) + 1), cells, cmap=colours, vmin=-0.5, vmax=vmax, rasterized=True)
    axes.set_title("motion state", loc="left", fontsize="small")


def _draw_votes(axes: Axes, seconds: Sequence[float], grid: NDArray[np.float64]) -> None:
    _draw_scale(axes, seconds, grid, vmin=0.5, vmax=float(np.nanmax(grid)), integer=True)  # no votes: below the scale
    axes.set_title("votes (grey: none)", loc="left", fontsize="small")


def _draw_chamfer(
    axes: Axes, seconds: Sequence[float], grid: NDArray[np.float64], chamfer_threshold: float | None
) -> None:
    vmax = float(np.nanquantile(grid, _CHAMFER_QUANTILE))
    _draw_scale(axes, seconds, grid, vmin=0.0, vmax=vmax, integer=False)
    title = "Root-mean-square (Chamfer) distance to the object's earlier cloud [m]"
    if chamfer_threshold is not None:
        title += f"; threshold {chamfer_threshold:g} m, and the free-space check has to agree"
    axes.set_title(title, loc="left", fontsize="small")


def _draw_scale(
    axes: Axes, seconds: Sequence[float], grid: NDArray[np.float64], *, vmin: float, vmax: float, integer: bool
) -> None:
    """Draw a grid with a colour scale; values below the scale are pale."""
    colours = colormaps["viridis"].with_extremes(under=(0.5, 0.5, 0.5, 0.2))
    edges, cells = frame_cells(seconds, grid)
    mesh = axes.pcolormesh(edges, np.arange(len(grid) + 1), cells, cmap=colours, vmin=vmin, vmax=vmax, rasterized=True)
    ticks = MaxNLocator(4, integer=integer, min_n_ticks=1)  # one vote is a scale with one whole number
    axes.figure.colorbar(mesh, ax=axes, pad=0.01, aspect=12, ticks=ticks)
