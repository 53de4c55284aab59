"""Placement of labels in a figure, so that none covers another."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.transforms import Bbox


def draw_legend_and_separate_labels(figure: Figure, handles: Sequence[Artist], columns: int) -> None:
    """Draw a legend below all axes, and separate the labels; the legend has the number of labels that are left out.

    Args:
        figure: Figure with all of its content but the legend.
        handles: Entries of the legend.
        columns: Maximum number of columns of the legend.
    """
    legend = _draw_legend(figure, handles, columns)
    if hidden := separate_labels(figure):
        legend.remove()
        note = Line2D([], [], linestyle="none", label=f"{hidden} {'name' if hidden == 1 else 'names'} left out")
        _draw_legend(figure, [*handles, note], columns)


def separate_labels(figure: Figure) -> int:
    """Move the texts of all axes into their axes, and down until none overlaps another; hide those without a place.

    Args:
        figure: Figure with all of its content, because the layout determines the sizes.

    Returns:
        Number of hidden texts.
    """
    figure.draw_without_rendering()  # determines the size of the axes and of the texts
    return sum(_separate(axes) for axes in figure.axes)


def _draw_legend(figure: Figure, handles: Sequence[Artist], columns: int) -> Legend:
    return figure.legend(handles=handles, loc="outside lower center", ncols=columns, frameon=False)


def _separate(axes: Axes) -> int:
    labels, boxes = [text for text in axes.texts if text.get_text()], list[Bbox]()
    for label in sorted(labels, key=lambda text: text.get_window_extent().y0, reverse=True):
        start = label.get_window_extent()
        patch = label.get_bbox_patch()
        if patch is not None:
            start = Bbox.union([start, patch.get_window_extent()])
        left, bottom = min(start.x0, axes.bbox.x1 - start.width), max(start.y0, axes.bbox.y0)
        box = Bbox.from_bounds(left, bottom, start.width, start.height)
        while any(box.overlaps(other) for other in boxes):
            box = box.translated(0.0, -0.5 * box.height)
        if box.y0 < axes.bbox.y0:
            label.set_visible(False)
            continue
        boxes.append(box)
        x, y = axes.transData.transform(label.get_position())
        moved = x + box.x0 - start.x0, y + box.y0 - start.y0
        label.set_position(tuple(axes.transData.inverted().transform(moved)))
    return len(labels) - len(boxes)
