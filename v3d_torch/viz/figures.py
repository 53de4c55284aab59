"""Figures of a run: the trajectory in the style of the paper, and what the object stage thought of each object."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Patch
from torch import Tensor

from v3d_torch.evaluation.association import match
from v3d_torch.evaluation.ate import absolute_errors, align
from v3d_torch.evaluation.evaluation import is_oriented
from v3d_torch.evaluation.statistics import Statistics
from v3d_torch.io.files import atomic_write
from v3d_torch.types import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

Overlay = tuple[Tensor, str, str]
"""Mask (bool, H x W), text such as "person 3", verdict such as "dynamic"."""

MOTION_STATE_COLOURS = {
    "static": "#2ca02c",
    "dynamic": "#d62728",
    "deforming": "#ff7f0e",
    "predicted": "#9467bd",
    "unknown": "#7f7f7f",
}
"""Colour of each verdict; any other word is drawn as unknown."""

_MIN_HALF_RANGE = 0.01  # metres: the noise of a camera that stands still is not blown up to the size of a room
_MAX_FRAMES = 6
_COLUMNS = 3
_TINT = 0.45
_MARGIN = 0.12  # of the width: names of objects nearer to a side start there, so that they are not cut off


def trajectory_figure(groundtruth: Trajectory | None, estimate: Trajectory, path: Path, title: str = "") -> None:
    """Draw a trajectory to a file, see `draw_trajectory`.

    Args:
        groundtruth: true poses, or None.
        estimate: estimated poses, any number.
        path: image to write; the suffix (.png, .pdf, .svg) chooses the format.
        title: printed above.

    Raises:
        OutputError: when the file cannot be written.
    """
    save(draw_trajectory(groundtruth, estimate, title), path)


def draw_trajectory(groundtruth: Trajectory | None, estimate: Trajectory, title: str = "") -> Figure:
    """Draw a trajectory as the paper's figures do: ground truth black, estimate blue, their difference red.

    The plane is that of the two axes along which the camera moves most. The estimate is aligned to the ground truth;
    without ground truth at its stamps it is drawn alone, in its own world.

    Args:
        groundtruth: true poses, or None.
        estimate: estimated poses, any number.
        title: printed above.
    """
    p_e = estimate.T_wc[:, :3, 3]
    curves: list[tuple[Tensor, Tensor, str, str]] = [(estimate.stamps, p_e, "tab:blue", "estimate")]
    segments, error = torch.zeros(0, 2, 3), 0.0
    matches = match(groundtruth, estimate) if groundtruth is not None else None
    if groundtruth is not None and matches:
        T_gc, T_ec = groundtruth.T_wc[matches.groundtruth], estimate.T_wc[matches.estimate]
        alignment = align(T_gc, T_ec, oriented=is_oriented(groundtruth))
        aligned = p_e @ alignment.T_ge[:3, :3].mT + alignment.T_ge[:3, 3]
        segments = torch.stack([T_gc[:, :3, 3], aligned[matches.estimate]], dim=1)
        error = Statistics.of(absolute_errors(T_gc, T_ec, alignment)).rmse
        curves = [
            (groundtruth.stamps, groundtruth.T_wc[:, :3, 3], "black", "ground truth"),
            (estimate.stamps, aligned, "tab:blue", "estimate"),
        ]
    figure = Figure(figsize=(6.4, 6.0), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    across, up = _widest_axes(curves[0][1])
    plane = [across, up]
    for stamps, positions, colour, label in curves:
        axes.plot(*with_gaps(stamps, positions[:, plane]).T, color=colour, linewidth=1.2, label=label)
        axes.plot(*positions[:1, plane].numpy().T, "o", color=colour, markeredgecolor="white", zorder=3)
    if len(segments):
        lines = list(segments[:, :, plane].numpy())
        axes.add_collection(LineCollection(lines, colors="tab:red", linewidths=0.7, alpha=0.7, zorder=1.5))
        axes.plot([], [], color="tab:red", linewidth=0.9, label=f"difference (ATE RMSE {error:.4f} m)")
    axes.plot([], [], "o", color="gray", label="start")
    _frame(axes, torch.cat([positions[:, plane] for _, positions, _, _ in curves]))
    axes.set(xlabel=f"{'xyz'[across]} [m]", ylabel=f"{'xyz'[up]} [m]")
    axes.set_title(title, parse_math=False)  # a folder's name may hold dollars
    axes.grid(True, linewidth=0.4, alpha=0.5)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    return figure


def mask_strip(images: Sequence[Tensor], overlays: Sequence[Sequence[Overlay]], path: Path) -> None:
    """Draw frames in a grid with their objects' masks coloured by verdict.

    Args:
        images: uint8 RGB, shape :math:`(3, H, W)` each; the first six are drawn.
        overlays: for each image its objects: mask (bool, shape :math:`(H, W)`), text, verdict (`MOTION_STATE_COLOURS`).
        path: image to write.

    Raises:
        OutputError: when the file cannot be written.
        ValueError: there is no image, or not a list of objects for each.
    """
    if not images:
        raise ValueError("a strip of masks needs at least one image")
    frames = list(zip(images, overlays, strict=True))[:_MAX_FRAMES]
    columns = min(_COLUMNS, len(frames))
    rows = -(-len(frames) // columns)
    height, width = images[0].shape[1:]
    cell = 4.0  # inches
    tight = ConstrainedLayoutEngine(w_pad=0.02, h_pad=0.02, wspace=0, hspace=0)
    figure = Figure(figsize=(cell * columns, cell * height / width * rows + 0.4), dpi=120, layout=tight)
    FigureCanvasAgg(figure)
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in grid:
        axes.axis("off")
    for axes, (image, objects) in zip(grid, frames, strict=False):
        draw_objects(axes, image, objects)
    present = {parse_motion_state(verdict) for _, objects in frames for _, _, verdict in objects}
    handles = [
        Patch(color=colour, label=verdict) for verdict, colour in MOTION_STATE_COLOURS.items() if verdict in present
    ]
    if handles:
        figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    save(figure, path)


def _widest_axes(positions: Tensor) -> tuple[int, int]:
    """The two axes along which positions extend farthest, in the order x, y, z."""
    if not len(positions):
        return 0, 1
    extent = positions.amax(dim=0) - positions.amin(dim=0)
    across, up = extent.argsort(descending=True, stable=True)[:2].sort().values.tolist()
    return across, up


def with_gaps(stamps: Tensor, points: Tensor) -> NDArray[np.float64]:
    """Points, shape (N, 2), with a NaN, which ends the pen's stroke, wherever there is none for long."""
    if len(stamps) < 2:
        return points.numpy()
    intervals = stamps.diff()
    after = (intervals > 10 * intervals.median()).nonzero()[:, 0].numpy() + 1
    return np.insert(points.numpy(), after, np.nan, axis=0)


def _frame(axes: Axes, points: Tensor) -> None:
    """A square view, equal scales, that holds points (N, 2)."""
    if not len(points):
        points = torch.zeros(1, 2)
    low, high = points.amin(dim=0), points.amax(dim=0)
    half = max(0.55 * float((high - low).max()), _MIN_HALF_RANGE)
    (x, y) = ((low + high) / 2).tolist()
    axes.set(xlim=(x - half, x + half), ylim=(y - half, y + half), aspect="equal")
    axes.locator_params(nbins=6)


def draw_objects(axes: Axes, image: Tensor, objects: Sequence[Overlay]) -> None:
    """Draw an image with its objects: masks tinted and outlined in the colour of the verdict, texts upon them.

    Args:
        axes: to draw on, in pixels of the image.
        image: uint8 RGB, shape :math:`(3, H, W)`.
        objects: masks, texts, verdicts; an empty text is not written.
    """
    picture = image.permute(1, 2, 0).numpy().astype(np.float32) / 255
    outlines = []
    for mask, _, verdict in objects:
        colour = MOTION_STATE_COLOURS[parse_motion_state(verdict)]
        inside = mask.numpy()
        picture[inside] = (1 - _TINT) * picture[inside] + _TINT * np.array(to_rgb(colour), dtype=np.float32)
        contours, _ = cv2.findContours(inside.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        outlines += [(np.concatenate([contour[:, 0], contour[:1, 0]]), colour) for contour in contours]
    axes.imshow(picture, interpolation="antialiased")
    axes.add_collection(
        LineCollection([line for line, _ in outlines], colors=[colour for _, colour in outlines], linewidths=1.2)
    )
    height, width = image.shape[1:]
    for mask, text, verdict in sorted(objects, key=lambda overlay: overlay[2] != "static"):  # who moves on top
        if not mask.any() or not text:
            continue
        colour = MOTION_STATE_COLOURS[parse_motion_state(verdict)]
        rows, columns = mask.nonzero(as_tuple=True)
        x, y = float(columns.double().mean()), float(rows.double().quantile(0.1))
        side = "left" if x < _MARGIN * width else "right" if x > (1 - _MARGIN) * width else "center"
        axes.annotate(
            text,
            (
                {"left": 0.02 * width, "right": 0.98 * width, "center": x}[side],
                min(max(y, 0.04 * height), 0.96 * height),
            ),
            color="white",
            fontsize=8,
            ha=side,
            va="center",
            bbox={
                "boxstyle": "round,pad=0.25",
                "facecolor": MOTION_STATE_COLOURS[parse_motion_state(verdict)],
                "edgecolor": "none",
            },
        )


def parse_motion_state(word: str) -> str:
    """The verdict itself, or unknown where it has no colour."""
    return word if word in MOTION_STATE_COLOURS else "unknown"


def save(figure: Figure, path: Path) -> None:
    """Write a figure whole or not at all; the suffix chooses the format.

    Raises:
        OutputError: when the file cannot be written.
    """
    with atomic_write(path) as temporary:
        figure.savefig(temporary)
