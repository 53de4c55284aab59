"""Placement of labels in a figure, so that none covers another."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox


def separate_labels(figure: Figure) -> None:
    """Move the texts of all axes into their axes, and down until none overlaps another; hide those without a place.

    Args:
        figure: Figure with all of its content, because the layout determines the sizes.
    """
    figure.draw_without_rendering()  # determines the size of the axes and of the texts
    for axes in figure.axes:
        _separate(axes)


def _separate(axes: Axes) -> None:
    labels, boxes = [text for text in axes.texts if text.get_text()], list[Bbox]()
    for label in sorted(labels, key=lambda text: text.get_window_extent().y0, reverse=True):
        start = label.get_window_extent()
        patch = label.get_bbox_patch()
        if patch is not None:
            start = Bbox.union([start, patch.get_window_extent()])
        box = start.translated(min(axes.bbox.x1 - start.x1, 0.0), 0.0)
        while any(box.overlaps(other) for other in boxes):
            box = box.translated(0.0, -0.5 * box.height)
        if box.y0 < axes.bbox.y0 - box.height:
            label.set_visible(False)
            continue
        boxes.append(box)
        x, y = axes.transData.transform(label.get_position())
        moved = x + box.x0 - start.x0, y + box.y0 - start.y0
        label.set_position(tuple(axes.transData.inverted().transform(moved)))
