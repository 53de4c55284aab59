"""Figure of a trajectory in the style of the paper: ground truth, estimate, and the difference between them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor
from torch.nn.functional import pad

from v3d_torch.evaluation.association import MAX_TIME_DIFFERENCE, associate_trajectories
from v3d_torch.evaluation.ate import absolute_errors, align
from v3d_torch.evaluation.evaluation import MIN_PAIRS, has_orientations
from v3d_torch.evaluation.statistics import Statistics
from v3d_torch.geometry.se3 import transform_points
from v3d_torch.types import Trajectory
from v3d_torch.viz.figure_output import save_figure
from v3d_torch.viz.fonts import draw_title
from v3d_torch.viz.time_gaps import insert_gaps

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MIN_HALF_RANGE = 0.01
"""Minimum half width of the view, metres, so that the pose noise of a static camera does not fill the figure."""

_MARGIN = 1.1
"""Width of the view divided by the extent of the trajectory."""

_GUESSED = ("disconnected", "lost")
"""Tracking statuses of poses that were not measured relative to the map."""


def save_trajectory_figure(
    groundtruth: Trajectory | None, estimate: Trajectory, path: Path, title: str = "", statuses: Sequence[str] = ()
) -> None:
    """Write a figure of a trajectory to a file, see `draw_trajectory`.

    Args:
        groundtruth: Ground-truth poses, or None.
        estimate: Estimated poses, any number.
        path: Image file; the suffix (.png, .pdf, .svg) selects the format.
        title: Title of the figure.
        statuses: Tracking status of each pose of the estimate; empty if it is not known.

    Raises:
        OutputError: If the file cannot be written.
    """
    save_figure(draw_trajectory(groundtruth, estimate, title, statuses), path)


def draw_trajectory(
    groundtruth: Trajectory | None, estimate: Trajectory, title: str = "", statuses: Sequence[str] = ()
) -> Figure:
    """Draw a trajectory as in the paper's figures: ground truth black, estimate blue, their difference red.

    The trajectory is projected onto the two axes with the largest extent. The estimate is aligned to the ground truth.
    With ground truth at the timestamps of fewer than three poses, which do not determine the alignment, the estimate
    is drawn alone, in its own world frame. Poses that were only guessed, of lost and of disconnected frames, are
    dotted.

    Args:
        groundtruth: Ground-truth poses, or None.
        estimate: Estimated poses, any number.
        title: Title of the figure.
        statuses: Tracking status of each pose of the estimate; empty if it is not known.
    """
    p_e = estimate.T_wc[:, :3, 3]
    curves: list[tuple[Tensor, Tensor, str, str]] = [(estimate.stamps, p_e, "tab:blue", "estimate")]
    segments, error = torch.zeros(0, 2, 3), 0.0
    matches = associate_trajectories(groundtruth, estimate) if groundtruth is not None else None
    if groundtruth is not None and matches is not None and len(matches) >= MIN_PAIRS:
        T_gc, T_ec = groundtruth.T_wc[matches.groundtruth], estimate.T_wc[matches.estimate]
        alignment = align(T_gc, T_ec, oriented=has_orientations(groundtruth))
        truth = within(groundtruth, estimate)
        aligned = transform_points(alignment.T_ge, p_e)
        segments = torch.stack([T_gc[:, :3, 3], aligned[matches.estimate]], dim=1)
        error = Statistics.of(absolute_errors(T_gc, T_ec, alignment)).rmse
        curves = [
            (truth.stamps, truth.T_wc[:, :3, 3], "black", "ground truth"),
            (estimate.stamps, aligned, "tab:blue", "estimate"),
        ]
    figure = Figure(figsize=(6.4, 6.0), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    horizontal, vertical = _widest_axes(curves[0][1])
    plane = [horizontal, vertical]
    guessed = [status for status in _GUESSED if status in statuses]
    for stamps, positions, colour, label in curves:
        points, guesses = positions[:, plane], None
        if label == "estimate" and guessed:
            points, guesses = _separate_guesses(points, statuses)
        if not points.isnan().all():  # else the legend would list a curve without points
            axes.plot(*insert_gaps(stamps, points).T, color=colour, linewidth=1.2, label=label)
        if guesses is not None:
            label = f"estimate, {' or '.join(guessed)}"
            axes.plot(*insert_gaps(stamps, guesses).T, ":", color="tab:orange", linewidth=1.5, label=label)
        axes.plot(*positions[:1, plane].numpy().T, "o", color=colour, markeredgecolor="white", zorder=3)
    if len(segments):
        lines = pad(segments[:, :, plane], (0, 0, 0, 1), value=torch.nan).flatten(0, 1)  # one path: small as SVG
        axes.plot(*lines.T, color="tab:red", linewidth=0.7, alpha=0.7, zorder=1.5)
        axes.plot([], [], color="tab:red", linewidth=0.9, label=f"difference (ATE RMSE {error:.4f} m)")
    axes.plot([], [], "o", color="gray", label="start")
    _set_square_view(axes, torch.cat([positions[:, plane] for _, positions, _, _ in curves]))
    axes.set(xlabel=f"{'xyz'[horizontal]} [m]", ylabel=f"{'xyz'[vertical]} [m]")
    draw_title(axes.set_title, title)
    axes.grid(True, linewidth=0.4, alpha=0.5)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    return figure


def within(groundtruth: Trajectory, estimate: Trajectory) -> Trajectory:
    """Return the part of a ground truth during an estimate: recordings of ground truth are often longer."""
    first, last = estimate.stamps[0] - MAX_TIME_DIFFERENCE, estimate.stamps[-1] + MAX_TIME_DIFFERENCE
    rows = (groundtruth.stamps >= first) & (groundtruth.stamps <= last)
    return groundtruth.select(rows)


def _separate_guesses(points: Tensor, statuses: Sequence[str]) -> tuple[Tensor, Tensor]:
    """Return the points of measured poses, and those of guessed poses and their neighbours; NaN at the other poses."""
    is_guess = torch.tensor([status in _GUESSED for status in statuses])
    touches_guess = is_guess.clone()
    touches_guess[1:] |= is_guess[:-1]
    touches_guess[:-1] |= is_guess[1:]
    return points.masked_fill(is_guess[:, None], torch.nan), points.masked_fill(~touches_guess[:, None], torch.nan)


def _widest_axes(positions: Tensor) -> tuple[int, int]:
    """Return the two axes along which positions extend farthest, in the order x, y, z."""
    if not len(positions):
        return 0, 1
    extent = positions.amax(dim=0) - positions.amin(dim=0)
    first, second = extent.argsort(descending=True, stable=True)[:2].sort().values.tolist()
    return first, second


def _set_square_view(axes: Axes, points: Tensor) -> None:
    """Set limits with equal scales that contain all points, shape (N, 2)."""
    if not len(points):
        points = torch.zeros(1, 2)
    low, high = points.amin(dim=0), points.amax(dim=0)
    half = max(_MARGIN / 2 * float((high - low).max()), _MIN_HALF_RANGE)
    (x, y) = ((low + high) / 2).tolist()
    axes.set(xlim=(x - half, x + half), ylim=(y - half, y + half), aspect="equal")
    axes.locator_params(nbins=6)
