"""Plots over time of the poses: positions, errors, tracking status, and the masked fraction of the image."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from torch import Tensor

from v3d_torch.evaluation import Evaluation
from v3d_torch.evaluation.association import associate_trajectories
from v3d_torch.evaluation.ate import absolute_errors
from v3d_torch.evaluation.rpe import motion_errors
from v3d_torch.geometry.se3 import transform_points
from v3d_torch.types import Trajectory
from v3d_torch.viz.time_axes import frame_cells, make_time_axes
from v3d_torch.viz.time_gaps import insert_gaps
from v3d_torch.viz.trajectory_figure import within

STATUS_COLOURS = {"tracked": "#1b6fb3", "odometry": "#7ab8d9", "disconnected": "#f2a900", "lost": "#d1341b"}
"""Colour of each tracking status, which colour-blind people can tell apart, too."""


def draw_positions(groundtruth: Trajectory | None, estimate: Trajectory, evaluation: Evaluation | None) -> Figure:
    """Draw x, y and z of the camera over time: ground truth black, the estimate, aligned to it, blue.

    Args:
        groundtruth: Ground-truth poses, or None.
        estimate: Estimated poses, at least one.
        evaluation: Evaluation of the estimate; None to draw the estimate alone in its own world frame.
    """
    start = estimate.stamps[0]
    positions = estimate.T_wc[:, :3, 3]
    figure, panels = make_time_axes((estimate.stamps - start).tolist(), [1.1] * 3, extra_height=0.2)
    if evaluation is not None and groundtruth is not None:
        positions = transform_points(evaluation.alignment.T_ge, positions)
        truth = within(groundtruth, estimate)
        _plot_positions(panels, truth.stamps - start, truth.T_wc[:, :3, 3], "black", "ground truth")
    _plot_positions(panels, estimate.stamps - start, positions, "tab:blue", "estimate")
    for axes, name in zip(panels, "xyz", strict=True):
        axes.set_ylabel(f"{name} [m]")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper right", ncols=2, frameon=False)
    return figure


def draw_errors(
    groundtruth: Trajectory, estimate: Trajectory, evaluation: Evaluation, statuses: Sequence[str]
) -> Figure:
    """Draw the absolute error of each pose over time, and the relative errors of the motion that begins at each pose.

    Args:
        groundtruth: Ground-truth poses.
        estimate: Estimated poses, one per frame.
        evaluation: Evaluation of the estimate.
        statuses: Tracking status of each frame. Frames that were not tracked are shaded.
    """
    matches = associate_trajectories(groundtruth, estimate)
    T_gc, T_ec = groundtruth.T_wc[matches.groundtruth], estimate.T_wc[matches.estimate]
    seconds = estimate.stamps - estimate.stamps[0]
    curves = [
        (
            seconds[matches.estimate],
            absolute_errors(T_gc, T_ec, evaluation.alignment),
            evaluation.ate.rmse,
            "position\nerror",
            "m",
        )
    ]
    if (rpe := evaluation.rpe) is not None:
        errors = motion_errors(groundtruth, estimate, matches, rpe.delta)
        delta = "s" if rpe.delta == 1 else f"{rpe.delta:g} s"
        times = seconds[errors.first]
        curves.append((times, errors.trans, rpe.trans.rmse, "translation\ndrift", f"m/{delta}"))
        curves.append((times, errors.rot, rpe.rot.rmse, "rotation\ndrift", f"deg/{delta}"))
    figure, panels = make_time_axes(seconds.tolist(), [1.3] * len(curves))
    for axes, (times, values, rmse, label, unit) in zip(panels, curves, strict=True):
        axes.plot(*insert_gaps(times, torch.stack([times, values], dim=1)).T, color="tab:red", linewidth=1.0)
        axes.axhline(rmse, color="black", linewidth=0.8, linestyle="--")
        axes.set_title(f"RMSE {rmse:.4f} {unit}", loc="right", fontsize="small")
        axes.set(ylabel=f"{label} [{unit}]", ylim=(0, None))
        _shade_untracked(axes, seconds, statuses)
    return figure


def draw_statuses(stamps: Tensor, statuses: Sequence[str], keyframes: Tensor) -> Figure:
    """Draw the tracking status of each frame, and mark the keyframes.

    Args:
        stamps: Timestamps of the frames, seconds, shape :math:`(N,)`.
        statuses: Tracking status of each frame.
        keyframes: Timestamps of the keyframes, seconds, shape :math:`(K,)`.
    """
    seconds = (stamps - stamps[0]).tolist()
    figure, (axes,) = make_time_axes(seconds, [0.6], extra_height=0.3)
    names = list(STATUS_COLOURS)
    row = np.array([[float(names.index(status)) for status in statuses]])
    colours = ListedColormap(list(STATUS_COLOURS.values()))
    vmax = len(names) - 0.5
    edges, row = frame_cells(seconds, row)
    axes.pcolormesh(edges, [0.35, 1.0], row, cmap=colours, vmin=-0.5, vmax=vmax, rasterized=True)
    (marks,) = axes.plot(keyframes - stamps[0], np.full(len(keyframes), 0.15), "|", color="black")
    marks.set_label(f"{len(keyframes)} {'keyframe' if len(keyframes) == 1 else 'keyframes'}")
    axes.set(ylim=(0, 1.05), yticks=[])
    axes.grid(False)
    counts = {status: list(statuses).count(status) for status in names}
    handles = [Patch(color=STATUS_COLOURS[name], label=f"{count} {name}") for name, count in counts.items() if count]
    figure.legend(handles=[*handles, marks], loc="outside upper right", ncols=5, frameon=False)
    return figure


def draw_masked_fraction(stamps: Tensor, fractions: Tensor) -> Figure:
    """Draw the fraction of the image that was left out of tracking.

    Args:
        stamps: Timestamps, seconds, shape :math:`(N,)`.
        fractions: Masked fraction of each image, 0 to 1, shape :math:`(N,)`.
    """
    seconds = (stamps - stamps[0]).tolist()
    figure, (axes,) = make_time_axes(seconds, [1.2])
    times, percent = insert_gaps(stamps, torch.stack([stamps - stamps[0], 100 * fractions], dim=1)).T
    axes.fill_between(times, percent, color="tab:purple", alpha=0.5, linewidth=0, step="mid")
    axes.set(ylabel="masked [%]", ylim=(0, 100))
    return figure


def _plot_positions(panels: Sequence[Axes], seconds: Tensor, positions: Tensor, colour: str, label: str) -> None:
    marker = "." if len(seconds) == 1 else None  # a line of one point is invisible
    for i, axes in enumerate(panels):
        curve = insert_gaps(seconds, torch.stack([seconds, positions[:, i]], dim=1))
        axes.plot(*curve.T, color=colour, linewidth=1.0, marker=marker, label=label)


def _shade_untracked(axes: Axes, seconds: Tensor, statuses: Sequence[str]) -> None:
    """Shade the frames that were not tracked in the colour of their status."""
    step = float(seconds.diff().median()) if len(seconds) > 1 else 1.0
    for name, colour in STATUS_COLOURS.items():
        spans = [(t - step / 2, step) for t, status in zip(seconds.tolist(), statuses, strict=False) if status == name]
        if name != "tracked" and spans:
            axes.broken_barh(spans, (0, 1), transform=axes.get_xaxis_transform(), color=colour, alpha=0.25, linewidth=0)
