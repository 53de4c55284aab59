"""Poses and their errors over time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.evaluation.association import match
from v3d_torch.evaluation.ate import absolute_errors
from v3d_torch.evaluation.evaluation import Evaluation
from v3d_torch.evaluation.rpe import drift
from v3d_torch.types import Trajectory
from v3d_torch.viz.figures import with_gaps

STATUS_COLOURS = {"tracked": "#2ca02c", "odometry": "#1f77b4", "disconnected": "#ff7f0e", "lost": "#d62728"}
"""Colour of each way in which a frame's pose was found."""

WIDTH = 9.0
"""Of all plots over time, inches."""


def rows(seconds: Sequence[float], heights: Sequence[float], *, labels: float = 0.0) -> tuple[Figure, list[Axes]]:
    """A figure of axes one below the other that share the time: that of the frames, the same in all plots of a run.

    Args:
        seconds: of the frames since the first.
        heights: of the axes, inches.
        labels: room for what stands around them, inches.
    """
    figure = Figure(figsize=(WIDTH, sum(heights) + 0.25 * len(heights) + 0.4 + labels), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
    for one in axes:
        one.spines[["top", "right"]].set_visible(False)
        one.grid(True, linewidth=0.4, alpha=0.4)
    margin = 0.01 * seconds[-1] + 1e-3
    axes[-1].set(xlabel="seconds since the first frame", xlim=(-margin, seconds[-1] + margin))
    return figure, list(axes)


def borders(seconds: Sequence[float]) -> NDArray[np.float64]:
    """Times halfway between frames, and before the first and after the last, shape (frames + 1,)."""
    if len(seconds) == 1:
        return np.array([seconds[0] - 0.5, seconds[0] + 0.5])
    at = np.asarray(seconds)
    middles = (at[1:] + at[:-1]) / 2
    return np.concatenate([[2 * at[0] - middles[0]], middles, [2 * at[-1] - middles[-1]]])


def draw_positions(groundtruth: Trajectory | None, estimate: Trajectory, evaluation: Evaluation | None) -> Figure:
    """x, y and z of the camera: ground truth black, the estimate, aligned to it, blue.

    Args:
        groundtruth: true poses, or None.
        estimate: at least one pose.
        evaluation: of the two; None draws the estimate alone in its own world.
    """
    start = estimate.stamps[0]
    positions = estimate.T_wc[:, :3, 3]
    figure, axes = rows((estimate.stamps - start).tolist(), [1.1] * 3, labels=0.2)
    if evaluation is not None and groundtruth is not None:
        T_ge = evaluation.alignment.T_ge
        positions = positions @ T_ge[:3, :3].mT + T_ge[:3, 3]
        _plot_positions(axes, groundtruth.stamps - start, groundtruth.T_wc[:, :3, 3], "black", "ground truth")
    _plot_positions(axes, estimate.stamps - start, positions, "tab:blue", "estimate")
    for one, name in zip(axes, "xyz", strict=True):
        one.set_ylabel(f"{name} [m]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=2, frameon=False)
    return figure


def draw_errors(
    groundtruth: Trajectory, estimate: Trajectory, evaluation: Evaluation, statuses: Sequence[str]
) -> Figure:
    """The absolute error of each pose, and the drift over the time of the RPE from each pose on.

    Args:
        groundtruth: true poses.
        estimate: poses, one per frame.
        evaluation: of the two.
        statuses: how each pose was found; all that were not tracked are marked.
    """
    matches = match(groundtruth, estimate)
    T_gc, T_ec = groundtruth.T_wc[matches.groundtruth], estimate.T_wc[matches.estimate]
    seconds = estimate.stamps - estimate.stamps[0]
    curves = [
        (
            seconds[matches.estimate],
            absolute_errors(T_gc, T_ec, evaluation.alignment),
            evaluation.ate.rmse,
            "position [m]",
            "m",
        )
    ]
    if (rpe := evaluation.rpe) is not None:
        errors = drift(groundtruth, estimate, matches, rpe.delta)
        over = "s" if rpe.delta == 1 else f"{rpe.delta:g} s"
        at = seconds[errors.first]
        curves.append((at, errors.trans, rpe.trans.rmse, f"drift [m/{over}]", f"m/{over}"))
        curves.append((at, errors.rot, rpe.rot.rmse, f"drift [deg/{over}]", f"deg/{over}"))
    figure, axes = rows(seconds.tolist(), [1.3] * len(curves))
    for one, (at, values, rmse, label, unit) in zip(axes, curves, strict=True):
        one.plot(*with_gaps(at, torch.stack([at, values], dim=1)).T, color="tab:red", linewidth=1.0)
        one.axhline(rmse, color="black", linewidth=0.8, linestyle="--")
        one.set_title(f"RMSE {rmse:.4f} {unit}", loc="right", fontsize="small")
        one.set(ylabel=label, ylim=(0, None))
        _shade(one, seconds, statuses)
    return figure


def draw_statuses(stamps: Tensor, statuses: Sequence[str], keyframes: Tensor) -> Figure:
    """How each frame was found, and which became keyframes.

    Args:
        stamps: of the frames, seconds, shape :math:`(N,)`.
        statuses: of the frames.
        keyframes: their stamps, seconds, shape :math:`(K,)`.
    """
    seconds = (stamps - stamps[0]).tolist()
    figure, (axes,) = rows(seconds, [0.6], labels=0.3)
    known = list(STATUS_COLOURS)
    row = np.array([[float(known.index(status)) for status in statuses]])
    colours = ListedColormap(list(STATUS_COLOURS.values()))
    axes.pcolormesh(borders(seconds), [0.35, 1.0], row, cmap=colours, vmin=-0.5, vmax=len(known) - 0.5, rasterized=True)
    (marks,) = axes.plot(keyframes - stamps[0], np.full(len(keyframes), 0.15), "|", color="black")
    marks.set_label(f"{len(keyframes)} keyframes")
    axes.set(ylim=(0, 1.05), yticks=[])
    axes.grid(False)
    counts = {status: list(statuses).count(status) for status in known}
    handles = [Patch(color=STATUS_COLOURS[one], label=f"{count} {one}") for one, count in counts.items() if count]
    figure.legend(handles=[*handles, marks], loc="outside upper right", ncols=5, frameon=False)
    return figure


def draw_share(stamps: Tensor, shares: Tensor) -> Figure:
    """Which share of the image was left out of tracking.

    Args:
        stamps: seconds, shape :math:`(N,)`.
        shares: 0 to 1, shape :math:`(N,)`.
    """
    seconds = (stamps - stamps[0]).tolist()
    figure, (axes,) = rows(seconds, [1.2])
    axes.fill_between(seconds, 100 * shares, color="tab:purple", alpha=0.5, linewidth=0, step="mid")
    axes.set(ylabel="left out [%]", ylim=(0, 100))
    return figure


def _plot_positions(axes: Sequence[Axes], seconds: Tensor, positions: Tensor, colour: str, label: str) -> None:
    for i, one in enumerate(axes):
        curve = with_gaps(seconds, torch.stack([seconds, positions[:, i]], dim=1))
        one.plot(*curve.T, color=colour, linewidth=1.0, label=label)


def _shade(axes: Axes, seconds: Tensor, statuses: Sequence[str]) -> None:
    """Mark the frames that were not tracked by a ground of their status' colour."""
    step = float(seconds.diff().median()) if len(seconds) > 1 else 1.0
    for status, colour in STATUS_COLOURS.items():
        spans = [(t - step / 2, step) for t, found in zip(seconds.tolist(), statuses, strict=False) if found == status]
        if status != "tracked" and spans:
            axes.broken_barh(spans, (0, 1), transform=axes.get_xaxis_transform(), color=colour, alpha=0.25, linewidth=0)
