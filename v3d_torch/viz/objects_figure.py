"""Figure of the objects of a run from above: their paths and boxes in the room, with the path of the camera."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patheffects import Normal, Stroke
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.geometry.level_frame import level_frame
from v3d_torch.objects.frame_objects import MotionState
from v3d_torch.pipeline.run_record import ObjectTable
from v3d_torch.segmentation.coco import class_name
from v3d_torch.types import Trajectory
from v3d_torch.viz.fonts import draw_title
from v3d_torch.viz.label_placement import separate_labels
from v3d_torch.viz.object_overlay import MOTION_STATE_COLOURS
from v3d_torch.viz.time_gaps import insert_gaps

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MAX_POINTS = 60_000
"""Number of points of the static map that are drawn."""

_MIN_FRAMES = 5
"""Objects of fewer frames are not drawn: most are false detections."""

_MAX_GAP = 5
"""Number of frames between two places of an object above which its path between them is not drawn."""

_MAX_NAMES = 50
"""Number of objects with a name: more names hide the figure, and the time to separate them increases with the square of
their number."""

_STATES = tuple(MotionState)
_MOVING = torch.tensor([_STATES.index(state) for state in (MotionState.DYNAMIC, MotionState.DEFORMING)])


def draw_objects_from_above(
    objects: ObjectTable, trajectory: Trajectory, points: Tensor, up: Tensor, title: str = ""
) -> Figure:
    """Draw the objects of a run from above, in the level frame.

    A line is the path of an object, in the colour of its motion state in each frame. Its last box is outlined, with its
    name, and an arrow to where it would be a second later if it is dynamic. Static points of the map are grey. If there
    are many objects, only some have a name: those that were dynamic or deforming, then those with the most frames.

    Args:
        objects: Objects of all frames.
        trajectory: Poses of all frames.
        points: Points of the static map, world frame, metres, shape :math:`(P, 3)`.
        up: Direction against gravity, world frame, shape :math:`(3,)`.
        title: Title of the figure.
    """
    R_lw = level_frame(up)[:3, :3]
    figure = Figure(figsize=(7.5, 6.5), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    background = points[:: max(1, -(-len(points) // _MAX_POINTS))].to(torch.float64) @ R_lw.T
    x, y, _ = background.T.numpy()
    axes.scatter(x, y, s=0.3, color="#c8c8c8", linewidths=0, rasterized=True)
    path = (trajectory.T_wc[:, :3, 3] @ R_lw.T)[:, :2]
    axes.plot(*insert_gaps(trajectory.stamps, path).T, color="black", linewidth=1.2, label="camera path")
    rows, omitted = _rows_of_objects(objects)
    named = set(_select_names(objects, rows))
    for number in rows:
        _draw_object(axes, objects, rows[number], R_lw, with_name=number in named)
    drawn = {_STATES[code].value for own in rows.values() for code in objects["motion_state"][own].tolist()}
    for state, colour in MOTION_STATE_COLOURS.items():
        if state in drawn:
            axes.plot([], [], color=colour, label=state)
    unnamed = len(rows) - len(named)
    axes.set(xlabel=_axis_label(omitted, unnamed), ylabel="y [m]", aspect="equal")
    axes.grid(True, linewidth=0.4, alpha=0.5)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False)
    draw_title(axes.set_title, title)
    if hidden := separate_labels(figure):
        axes.set_xlabel(_axis_label(omitted, unnamed + hidden))
    return figure


def _axis_label(omitted: int, unnamed: int) -> str:
    """Return the label of the x axis, and below it the numbers of objects that are not drawn or have no name."""
    notes = []
    if omitted:
        notes.append(f"not drawn: {omitted} that were measured in fewer than {_MIN_FRAMES} frames")
    if unnamed:
        notes.append(f"without a name: {unnamed}")
    return f"x [m]\n{'; '.join(notes)}" if notes else "x [m]"


def _rows_of_objects(objects: ObjectTable) -> tuple[dict[int, Tensor], int]:
    """Return the rows of each object that is drawn, in the order of the frames, by id; and the number of the others."""
    order = objects["id"].argsort(stable=True)
    ids, counts = objects["id"][order].unique_consecutive(return_counts=True)
    rows = dict(zip(ids.tolist(), order.split(counts.tolist()), strict=True))
    is_measured = objects["box"][:, 0].isfinite()
    drawn = {number: own for number, own in rows.items() if is_measured[own].sum() >= _MIN_FRAMES}
    return drawn, len(rows) - len(drawn)


def _select_names(objects: ObjectTable, rows: dict[int, Tensor]) -> list[int]:
    """Return the ids of the objects with a name."""
    is_moving = torch.isin(objects["motion_state"], _MOVING)
    rank = {number: (not is_moving[own].any(), -len(own), number) for number, own in rows.items()}
    return sorted(rows, key=rank.__getitem__)[:_MAX_NAMES]


def _draw_object(axes: Axes, objects: ObjectTable, rows: Tensor, R_lw: Tensor, *, with_name: bool) -> None:
    """Draw path, last box and velocity of the object of some rows."""
    centroid = (objects["centroid"][rows] @ R_lw.T)[:, :2].numpy()
    colours = [MOTION_STATE_COLOURS[_STATES[code].value] for code in objects["motion_state"][rows].tolist()]
    seen = (objects["frame"][rows].diff() <= _MAX_GAP).nonzero()[:, 0].tolist()
    segments = [centroid[first : first + 2] for first in seen]
    axes.add_collection(LineCollection(segments, colors=[colours[first + 1] for first in seen], linewidths=1.5))
    box = objects["box"][rows]
    last = int(box[:, 0].isfinite().nonzero()[-1])
    outline = box_outline(box[last], R_lw)
    axes.plot(*outline.T, color=colours[last], linewidth=1.0)
    if with_name:
        name = f"{class_name(int(objects['label'][rows][last]))} {int(objects['id'][rows][last])}"
        rim = [Stroke(linewidth=1.5, foreground="white"), Normal()]  # lines of the same colour would hide the name
        axes.annotate(name, outline.max(axis=0), fontsize=6, color=colours[last], path_effects=rim)
    if colours[last] == MOTION_STATE_COLOURS["dynamic"]:
        x, y = (R_lw @ objects["velocity"][rows][last])[:2].tolist()
        tip, arrow = centroid[last] + (x, y), {"arrowstyle": "->", "color": colours[last]}
        axes.update_datalim([tip])  # an arrow that ends outside of the axes is not drawn
        axes.annotate("", tip, centroid[last], arrowprops=arrow)


def box_outline(box: Tensor, R_lw: Tensor) -> NDArray[np.float64]:
    """Return the closed outline of a box from above, level frame, metres, shape :math:`(5, 2)`.

    Args:
        box: Centre (world frame), size and yaw of an `UprightBox`, float64, shape :math:`(7,)`.
        R_lw: Rotation from the world to the level frame, float64, shape :math:`(3, 3)`.
    """
    centre, (length, width), yaw = (R_lw @ box[:3])[:2].numpy(), box[3:5].tolist(), float(box[6])
    forward, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    signs = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1), (1, 1)]) / 2
    return np.asarray(centre + signs[:, :1] * length * forward + signs[:, 1:] * width * left)
