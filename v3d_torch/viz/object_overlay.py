"""Images with the masks and names of their objects, coloured by motion state."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Patch
from torch import Tensor

from v3d_torch.viz.figure_output import save_figure
from v3d_torch.viz.label_placement import draw_legend_and_separate_labels

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Overlay = tuple[Tensor, str, str]
"""Mask (bool, H x W), label such as "person 3", and motion state such as "dynamic"."""

MOTION_STATE_COLOURS = {
    "static": "#1b6fb3",
    "dynamic": "#d1341b",
    "deforming": "#f2a900",
    "unknown": "#909090",
}
"""Colour of each motion state, which colour-blind people can tell apart, too. Any other state is drawn as unknown."""

_MAX_FRAMES = 6
_COLUMNS = 3
_CELL_WIDTH = 4.0  # inches
_TINT = 0.45  # opacity of a mask
_SIDE_MARGIN = 0.12  # fraction of the width: a label closer to a side starts there, so that it is not cut off


def save_mask_figure(images: Sequence[Tensor], overlays: Sequence[Sequence[Overlay]], path: Path) -> None:
    """Write a grid of frames with the masks of their objects, coloured by motion state.

    Args:
        images: Frames, uint8 RGB, shape :math:`(3, H, W)` each; of more than six, six at equal intervals are drawn.
        overlays: Objects of each frame: mask (bool, shape :math:`(H, W)`), label and motion state.
        path: Image file; the suffix (.png, .pdf, .svg) selects the format.

    Raises:
        OutputError: If the file cannot be written.
        ValueError: If there is no image, or not one list of objects per image.
    """
    if not images:
        raise ValueError("a figure of masks needs at least one image")
    frames = list(zip(images, overlays, strict=True))
    if len(frames) > _MAX_FRAMES:
        frames = [frames[row] for row in np.linspace(0, len(frames) - 1, _MAX_FRAMES).round().astype(int)]
    columns = min(_COLUMNS, len(frames))
    rows = -(-len(frames) // columns)
    height, width = images[0].shape[1:]
    tight = ConstrainedLayoutEngine(w_pad=0.02, h_pad=0.02, wspace=0, hspace=0)
    size = (_CELL_WIDTH * columns, _CELL_WIDTH * height / width * rows + 0.4)
    figure = Figure(figsize=size, dpi=120, layout=tight)
    FigureCanvasAgg(figure)
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in grid:
        axes.axis("off")
    for axes, (image, objects) in zip(grid, frames, strict=False):
        draw_objects(axes, image, objects)
    present = {parse_motion_state(motion_state) for _, objects in frames for _, _, motion_state in objects}
    handles = [Patch(color=colour, label=name) for name, colour in MOTION_STATE_COLOURS.items() if name in present]
    if handles:
        draw_legend_and_separate_labels(figure, handles, len(MOTION_STATE_COLOURS) + 1)
    save_figure(figure, path)


def draw_objects(axes: Axes, image: Tensor, objects: Sequence[Overlay]) -> None:
    """Draw an image with its objects: masks tinted and outlined in the colour of the motion state, with labels.

    Args:
        axes: Axes to draw on, in pixels of the image.
        image: Image, uint8 RGB, shape :math:`(3, H, W)`.
        objects: Masks, labels and motion states; an empty label is not drawn.
    """
    picture = image.permute(1, 2, 0).numpy().copy()
    outlines = []
    for mask, _, motion_state in objects:
        colour = MOTION_STATE_COLOURS[parse_motion_state(motion_state)]
        inside = mask.numpy()
        picture[inside] = np.rint((1 - _TINT) * picture[inside] + _TINT * 255 * np.array(to_rgb(colour)))
        contours, _ = cv2.findContours(inside.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        outlines += [(np.concatenate([contour[:, 0], contour[:1, 0]]), colour) for contour in contours]
    axes.imshow(picture, interpolation="antialiased")
    axes.add_collection(
        LineCollection([line for line, _ in outlines], colors=[colour for _, colour in outlines], linewidths=1.2)
    )
    # Draw the labels of moving objects last, so that they are on top.
    for mask, label, motion_state in sorted(objects, key=lambda overlay: overlay[2] != "static"):
        rows, columns = np.nonzero(mask.numpy())  # NumPy is ten times as fast here as torch
        if len(rows) and label:
            position = float(columns.mean()), float(np.quantile(rows, 0.1))
            _draw_label(axes, mask.shape, position, label, MOTION_STATE_COLOURS[parse_motion_state(motion_state)])


def parse_motion_state(name: str) -> str:
    """Return the motion state, or ``unknown`` if it has no colour."""
    return name if name in MOTION_STATE_COLOURS else "unknown"


def _draw_label(axes: Axes, size: Sequence[int], position: tuple[float, float], label: str, colour: str) -> None:
    """Draw a label at a position (x, y), or as near to it as the label fits within the image (height, width)."""
    (height, width), (x, y) = size, position
    side = "left" if x < _SIDE_MARGIN * width else "right" if x > (1 - _SIDE_MARGIN) * width else "center"
    axes.annotate(
        label,
        (
            {"left": 0.02 * width, "right": 0.98 * width, "center": x}[side],
            min(max(y, 0.04 * height), 0.96 * height),
        ),
        color="black" if colour == MOTION_STATE_COLOURS["deforming"] else "white",
        fontsize=8,
        ha=side,
        va="center",
        bbox={"boxstyle": "round,pad=0.25", "facecolor": colour, "edgecolor": "none"},
    )
